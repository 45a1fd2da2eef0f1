"""Who may send poses: one sender at a time, allowed addresses, and proofs under a key."""

import hashlib
import hmac
import json
import re
import socket
import textwrap
import time
from pathlib import Path

import pytest

from drivers.pose import PoseSourceError, create_pose_source
from drivers.pose.senders import PoseProof, SenderGate, parse_allowed

KEY = bytes(range(16))
NOW_NS = 100_000_000_000
WALL_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
POSE = {"x_m": 1.0, "y_m": -2.0, "yaw_rad": 0.5, "position_std_m": 0.01, "yaw_std_rad": 0.02, "age_s": 0.0}
FIRST, SECOND = ("127.0.0.1", 4001), ("127.0.0.1", 4002)


def proven(body, sent_ns=WALL_NS, key=KEY):
    stamped = sent_ns.to_bytes(8, "big") + body
    return stamped + hmac.new(key, stamped, hashlib.sha256).digest()


def test_the_first_sender_is_kept_until_it_has_been_silent():
    gate = SenderGate(2.0)
    assert gate.may_send(FIRST, 0)
    # One that has not sent a good pose yet keeps nobody off.
    assert gate.may_send(SECOND, 0)
    gate.note_pose(FIRST, 0)
    for t_ns in range(0, 3 * SECOND_NS, SECOND_NS // 2):
        assert not gate.may_send(SECOND, t_ns)
        assert gate.may_send(FIRST, t_ns)
        gate.note_pose(FIRST, t_ns)
    assert not gate.may_send(SECOND, 4_400_000_000)
    assert gate.may_send(SECOND, 4_500_000_000)
    gate.note_pose(SECOND, 4_500_000_000)
    assert not gate.may_send(FIRST, 4_600_000_000)
    assert gate.refused.count == 8


def test_a_flood_of_refused_datagrams_is_reported_once_in_ten_seconds_with_their_number():
    gate = SenderGate()
    gate.note_pose(FIRST, 0)
    for t_ns in range(0, 21 * SECOND_NS, SECOND_NS // 100):
        gate.note_pose(FIRST, t_ns)
        gate.may_send(SECOND, t_ns)
    messages = gate.new_messages()
    assert len(messages) == 3
    assert (
        "127.0.0.1:4002 sends poses while 127.0.0.1:4001 does: not used (1 datagrams); stop one of them" in messages[0]
    )
    assert "(1000 datagrams)" in messages[1]
    assert gate.new_messages() == []


def test_made_up_addresses_do_not_fill_the_memory():
    gate = SenderGate(allow=["10.0.0.1"])
    for number in range(5000):
        assert not gate.may_send((f"172.16.{number // 256}.{number % 256}", 9), 0)
    assert len(gate._known) <= 1001
    assert gate.may_send(("10.0.0.1", 9), 0)


@pytest.mark.parametrize(
    ("addresses", "expected_error"),
    [
        ((), "empty"),
        (("localhost",), '"localhost" is not an IPv4'),
        (("10.0.0.0/40",), "not an IPv4"),
        (("::1",), "not an IPv4"),
    ],
)
def test_what_is_no_address_is_refused(addresses, expected_error):
    with pytest.raises(ValueError, match=expected_error):
        parse_allowed(addresses)


@pytest.mark.parametrize(
    ("datagram", "expected_refusal"),
    [
        (b"", "without the authentication code"),
        (b"x" * 39, "without the authentication code"),
        (json.dumps(POSE).encode(), "without the authentication code"),
        (proven(b"{}", key=bytes(16)), "without the authentication code"),
        (proven(b"{}")[:-1] + b"\0", "without the authentication code"),
        (proven(b"{}", WALL_NS - 1_100_000_000), "1 s old or ahead by their sender's clock"),
        (proven(b"{}", WALL_NS + 3_000_000_000), "3 s old or ahead by their sender's clock"),
        (proven(b"{}", WALL_NS - 500_000_000), "sent again, or out of order"),
        (proven(b"{}", 2**64 - 1), "by their sender's clock"),
    ],
)
def test_what_is_not_proven_or_not_of_now_is_refused(datagram, expected_refusal):
    assert expected_refusal in PoseProof(KEY, WALL_NS - 500_000_000).unwrap(datagram, WALL_NS)


def test_each_proven_datagram_counts_once_and_none_from_before_the_port_was_opened():
    proof = PoseProof(KEY, WALL_NS)
    first, second = proven(b"one", WALL_NS + 10), proven(b"two", WALL_NS + 20)
    assert proof.unwrap(first, WALL_NS + 30) == b"one"
    assert proof.unwrap(second, WALL_NS + 30) == b"two"
    assert isinstance(proof.unwrap(second, WALL_NS + 40), str)
    assert isinstance(proof.unwrap(first, WALL_NS + 40), str)
    again = PoseProof(KEY, WALL_NS + 50)
    assert isinstance(again.unwrap(second, WALL_NS + 60), str)


def test_over_a_real_socket_only_the_holder_of_the_key_is_heard(create_source, port):
    source = create_source("udp", port=port, key_file="pose.key", key=KEY)
    body = json.dumps(POSE).encode()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        stranger.sendto(body, ("127.0.0.1", port))
        datagram = proven(body, time.time_ns())
        sender.sendto(datagram, ("127.0.0.1", port))
        sender.sendto(datagram, ("127.0.0.1", port))
        poses = source.receive(NOW_NS, ())
    assert [(pose.x_m, pose.y_m) for pose in poses] == [(1.0, -2.0)]
    assert source.refused == 2
    (message,) = source.new_messages()
    assert "sends poses without the authentication code of pose.key_file: not used" in message


def test_the_pages_sender_with_a_key(create_source, port, tmp_path, monkeypatch):
    page = (Path(__file__).parents[3] / "docs/poses.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"\n(    import hashlib.*?5005\)\)\n)", page, flags=re.DOTALL)
    (tmp_path / "pose.key").write_text(KEY.hex() + "\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    source, names = create_source("udp", port=port, key=KEY), {}
    exec(textwrap.dedent(code).replace("5005", str(port)), names)
    names["send"](POSE)
    assert [pose.x_m for pose in source.receive(NOW_NS, ())] == [1.0]
    names["sender"].close()


def test_a_key_that_is_named_and_was_not_read_opens_nothing(port):
    with pytest.raises(PoseSourceError, match=r"the key of pose\.key was not read"):
        create_pose_source("udp", port=port, key_file="pose.key")
