"""Poses in datagrams: both forms, real sockets, hostile ones."""

import json
import math
import re
import shutil
import socket
import subprocess
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.pose import PoseSourceError
from drivers.pose.udp import pose_of
from tests.drivers.waiting import receive_until

NOW_NS = 100_000_000_000
POSE = {"x_m": 1.0, "y_m": -2.0, "yaw_rad": 0.5, "position_std_m": 0.01, "yaw_std_rad": 0.02}


@pytest.mark.parametrize("encode", [msgspec.json.encode, msgspec.msgpack.encode], ids=["json", "msgpack"])
def test_a_datagram_is_a_pose_at_its_own_time(encode):
    pose = pose_of(encode({**POSE, "age_s": 0.04}), NOW_NS)
    assert (pose.t_ns, pose.received_ns) == (NOW_NS - 40_000_000, NOW_NS)
    assert (pose.x_m, pose.y_m, pose.yaw_rad, pose.position_std_m, pose.yaw_std_rad) == tuple(POSE.values())
    assert pose_of(encode({**POSE, "t_ns": NOW_NS - 7}), NOW_NS).t_ns == NOW_NS - 7


def test_a_pose_may_be_stamped_until_it_is_read():
    datagram = json.dumps({**POSE, "t_ns": NOW_NS + 9}).encode()
    pose = pose_of(datagram, NOW_NS, read_ns=NOW_NS + 9)
    assert (pose.t_ns, pose.received_ns) == (NOW_NS + 9, NOW_NS + 9)
    assert "is -1e-09 s old" in pose_of(datagram, NOW_NS, read_ns=NOW_NS + 8)
    older = json.dumps({**POSE, "t_ns": NOW_NS - 9}).encode()
    assert pose_of(older, NOW_NS, read_ns=NOW_NS + 9).received_ns == NOW_NS


def test_a_pose_that_is_stamped_while_a_tick_is_about_to_read_is_not_lost(create_source, port):
    source = create_source("udp", port=port)
    tick_ns = time.monotonic_ns()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        stamped_ns = time.monotonic_ns()
        sender.sendto(json.dumps({**POSE, "t_ns": stamped_ns}).encode(), ("127.0.0.1", port))
        assert [pose.t_ns for pose in source.receive(tick_ns, ())] == [stamped_ns]
    assert source.refused == 0
    source.close()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"age_s": -1.0}, "is -1 s old"),
        ({"age_s": 11.0}, "is 11 s old by this computer's clock, not 0 to 10 s"),
        ({"t_ns": NOW_NS + 1}, "is -1e-09 s old"),
        ({}, "without age_s or t_ns"),
        ({"age_s": 0.0, "x_m": "1"}, "Expected `float`, got `str`"),
        ({"age_s": 0.0, "position_std_m": -1.0}, "a standard deviation that cannot be"),
        ({"age_s": 0.0, "x_m": None}, "Expected `float`, got `null`"),
        ({"age_s": 0.0, "yaw_rad": None}, "half a heading"),
        ({"age_s": 0.0, "yaw_std_rad": None}, "half a heading"),
        # Numbers that are numbers, and too large to be turned into integers or to be squared.
        ({"age_s": 1e300}, "is 1e+300 s old"),
        ({"t_ns": 10**400}, "Expected `int` <= 9223372036854775807"),
        ({"t_ns": -(10**400)}, "Expected `int` >= 0"),
        ({"age_s": 0.0, "position_std_m": 1e200}, "a standard deviation that cannot be"),
        ({"age_s": 0.0, "x_m": -1e200}, "a position or a standard deviation that cannot be"),
        ({"age_s": 0.0, "y_m": 1e200}, "a position or a standard deviation that cannot be"),
    ],
)
def test_of_what_is_no_pose_of_now_it_is_said_why(change, text):
    assert text in pose_of(json.dumps({**POSE, **change}).encode(), NOW_NS)


@pytest.mark.parametrize("encode", [msgspec.json.encode, msgspec.msgpack.encode], ids=["json", "msgpack"])
def test_a_position_without_heading_is_one_and_says_so(encode):
    for absent in ({}, {"yaw_rad": None, "yaw_std_rad": None}):
        pose = pose_of(encode({"x_m": 1.0, "y_m": -2.0, "position_std_m": 0.01, "age_s": 0.0, **absent}), NOW_NS)
        assert (pose.x_m, pose.y_m, pose.position_std_m, pose.has_heading) == (1.0, -2.0, 0.01, False)


@pytest.mark.parametrize(
    ("change", "has_heading"),
    [
        ({}, True),
        ({"yaw_std_rad": -1.0}, False),
        ({"yaw_std_rad": math.nan}, False),
        ({"yaw_std_rad": 1e200}, False),
        ({"yaw_rad": -1e200}, False),
        ({"yaw_rad": math.nan}, False),
        ({"yaw_rad": 0.0, "yaw_std_rad": 0.0}, False),
        ({"yaw_rad": 0.0}, True),
        ({"yaw_std_rad": 0.0}, True),
    ],
)
def test_a_heading_that_nobody_has_filled_in_is_left_out_and_the_position_is_kept(change, has_heading):
    pose = pose_of(msgspec.msgpack.encode({**POSE, "age_s": 0.0, **change}), NOW_NS)
    assert (pose.x_m, pose.y_m, pose.has_heading) == (1.0, -2.0, has_heading)


@pytest.mark.parametrize("literal", [b"NaN", b"1e999", b"-Infinity"])
def test_a_number_that_is_not_finite_is_none(literal):
    text = json.dumps({**POSE, "age_s": 0.0}).encode().replace(b"-2.0", literal)
    assert isinstance(pose_of(text, NOW_NS), str)


@given(st.binary(max_size=200))
def test_no_bytes_break_it(datagram):
    assert pose_of(datagram, NOW_NS).startswith("what cannot be read as one (")


def test_over_a_real_socket_in_order_and_the_malformed_counted_and_said(create_source, port):
    source = create_source("udp", port=port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for age_s in (0.01, 0.05):
            sender.sendto(json.dumps({**POSE, "age_s": age_s}).encode(), ("127.0.0.1", port))
        sender.sendto(b"hello", ("127.0.0.1", port))
        assert [NOW_NS - pose.t_ns for pose in source.receive(NOW_NS, ())] == [50_000_000, 10_000_000]
    assert source.refused == 1
    (text,) = source.new_messages()
    assert re.fullmatch(
        r"127\.0\.0\.1:\d+ sends no pose but what cannot be read as one \(.*\): not used \(1 datagrams\); docs/.*", text
    )
    assert list(source.receive(NOW_NS, ())) == []
    source.close()
    source.close()
    assert list(source.receive(NOW_NS, ())) == []


def test_a_port_that_is_taken_is_refused_in_one_line(create_source, port):
    create_source("udp", port=port)
    with pytest.raises(PoseSourceError, match=rf"127\.0\.0\.1:{port}: .*; choose another pose\.port"):
        create_source("udp", port=port)


def sent_from_the_page(language, port):
    """The page's sender in this language, to this port."""
    page = (Path(__file__).parents[3] / "docs/poses.md").read_text(encoding="utf-8")
    (code,) = re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)
    return code.replace("5005", str(port))


def arrived(source):
    (pose,), _ = receive_until(source, lambda found, _: found)
    return pose.x_m, pose.y_m, pose.yaw_rad, pose.received_ns - pose.t_ns


def test_the_pages_sender_in_python(create_source, port):
    source, names = create_source("udp", port=port), {}
    exec(sent_from_the_page("python", port), names)
    names["send"](1.5, -2.0, 0.25, 0.04)
    assert arrived(source) == (1.5, -2.0, 0.25, 40_000_000)


def test_the_pages_sender_in_cpp(create_source, port, tmp_path):
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    (tmp_path / "send.cpp").write_text(
        sent_from_the_page("cpp", port) + "int main() { send_pose(1.5, -2.0, 0.25, 0.04); }\n", encoding="utf-8"
    )
    command = [compiler, "-std=c++11", "-Wall", "-Wextra", "-Werror", "-o", tmp_path / "send", tmp_path / "send.cpp"]
    subprocess.run(command, check=True, timeout=120)
    source = create_source("udp", port=port)
    subprocess.run([tmp_path / "send"], check=True, timeout=60)
    assert arrived(source) == (1.5, -2.0, 0.25, 40_000_000)
