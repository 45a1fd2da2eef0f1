"""Poses from the bridge: a Unix socket that only this user and root can say something on."""

import os
import socket
import subprocess
import sys
import time

import msgspec
import pytest

from drivers.pose import PoseSourceError, create_pose_source
from drivers.pose.ros2 import bridge_address

PORT = 40_000 + os.getpid() % 20_000
NOW_NS = 100_000_000_000
POSE = {"x_m": 1.0, "y_m": -2.0, "yaw_rad": 0.5, "position_std_m": 0.01, "yaw_std_rad": 0.02}
FROM_ANOTHER_PROCESS = """
import os, socket, sys
if sys.argv[2]:
    os.setuid(int(sys.argv[2]))
socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM).sendto(sys.stdin.buffer.read(), bytes.fromhex(sys.argv[1]))
"""


@pytest.fixture
def source():
    made = create_pose_source("ros2", port=PORT)
    yield made
    made.close()


def send_datagrams(*datagrams):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        for datagram in datagrams:
            sender.sendto(datagram, bridge_address(PORT))


def send_from_another_process(datagram, user=""):
    command = [sys.executable, "-c", FROM_ANOTHER_PROCESS, bridge_address(PORT).hex(), user]
    subprocess.run(command, input=datagram, check=True, timeout=60)


def test_poses_come_in_the_order_of_their_times_and_the_rest_is_counted(source):
    send_datagrams(*(msgspec.msgpack.encode({**POSE, "t_ns": NOW_NS - age}) for age in (10, 50)), b"hello", b"")
    assert [NOW_NS - pose.t_ns for pose in source.receive(NOW_NS, ())] == [50, 10]
    assert source.refused == 2
    (text,) = source.new_messages()
    assert text.startswith(f"the bridge process {os.getpid()} sends no pose but what cannot be read as one (")


def test_a_pose_that_is_stamped_while_a_tick_is_about_to_read_is_not_lost(source):
    tick_ns = time.monotonic_ns()
    stamped_ns = time.monotonic_ns()
    send_datagrams(msgspec.msgpack.encode({**POSE, "t_ns": stamped_ns}))
    assert [pose.t_ns for pose in source.receive(tick_ns, ())] == [stamped_ns]
    assert source.refused == 0


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")
def test_what_another_user_says_does_not_count(source):
    send_from_another_process(msgspec.msgpack.encode({**POSE, "t_ns": NOW_NS}), user="65534")
    assert list(source.receive(NOW_NS, ())) == []
    assert source.refused == 1
    (text,) = source.new_messages()
    assert "of user 65534 sends poses to the bridge's port: not used (1 datagrams); only the daemon's user" in text


def test_a_second_bridge_is_refused_and_named(source):
    send_datagrams(msgspec.msgpack.encode({**POSE, "t_ns": NOW_NS}), msgspec.json.encode({"said": "hello"}))
    send_from_another_process(msgspec.msgpack.encode({**POSE, "x_m": 9.0, "t_ns": NOW_NS}))
    assert [pose.x_m for pose in source.receive(NOW_NS, ())] == [1.0]
    greeting, refused = source.new_messages()
    assert greeting == "hello"
    assert f"sends poses while bridge process {os.getpid()} does: not used" in refused


def test_a_second_daemon_is_asked_to_take_another_port(source):
    with pytest.raises(PoseSourceError, match=rf"port {PORT}: .*; choose another pose\.port"):
        create_pose_source("ros2", port=PORT)


def test_a_source_that_was_closed_says_nothing_and_leaves_its_place(source):
    source.close()
    assert list(source.receive(NOW_NS, ())) == []
    create_pose_source("ros2", port=PORT).close()
