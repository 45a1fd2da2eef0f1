"""OptiTrack's datagrams, built here from the documented layout of each version and read equally by another's library.

No recording of Motive was to be had, but what NaturalPoint's own client showed of one.
"""

import math
import socket
import struct

import pytest
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drivers.pose import PoseSourceError, create_pose_source
from drivers.pose.natnet import VERSIONS, parse_frame, plane_pose
from tests.drivers.waiting import receive_until
from tests.tables import examples

# Turned by 0.7 rad about Motive's upward axis y, at 1.5 m along x and 2 m towards the viewer (z).
TURNED = (0.0, math.sin(0.35), 0.0, math.cos(0.35))
TEN_MHZ = 10_000_000


def count(version, items):
    """How many, from 4.1 on with how many bytes, and the items."""
    body = b"".join(items)
    return struct.pack("<i", len(items)) + (struct.pack("<i", len(body)) if version >= (4, 1) else b"") + body


def rigid_body(version, number=3, position=(1.5, 0.1, -2.0), rotation=TURNED, tracked=True):
    body = struct.pack("<i3f4f", number, *position, *rotation)
    if version < (3, 0):
        body += struct.pack("<i6f2i2f", 2, *[0.1] * 6, 7, 8, 0.01, 0.01)
    return body + struct.pack("<fh", 0.0004, int(tracked))


def labelled(version):
    marker = struct.pack("<i3ffh", (3 << 16) + 1, 0.1, 0.2, 0.3, 0.014, 2)
    return marker + (struct.pack("<f", 0.0002) if version >= (3, 0) else b"")


def frame(version, bodies, timestamp_s=12.5, exposed=1000 * TEN_MHZ, age_ticks=50_000, empty=False):
    """Every section has something in it, unless it is to be empty."""

    def some(*items):
        return count(version, [] if empty else items)

    channels = struct.pack("<iii2f", 1, 1, 2, 0.5, 0.25)
    payload = struct.pack("<i", 4711)
    payload += some(b"all\0" + struct.pack("<i3f", 1, 1.0, 2.0, 3.0)) + some(struct.pack("<3f", 4.0, 5.0, 6.0))
    payload += count(version, bodies)
    payload += some(struct.pack("<ii", 9, 1) + rigid_body(version, 99, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0)))
    if version >= (4, 1):
        payload += some(struct.pack("<iii", 5, 0, 0))
    payload += some(labelled(version))
    if version >= (2, 9):
        payload += some(channels)
    if version >= (2, 11):
        payload += some(channels)
    payload += struct.pack("<II", 0, 0) + struct.pack("<d" if version >= (2, 7) else "<f", timestamp_s)
    if version >= (3, 0):
        payload += struct.pack("<QQQ", exposed, exposed + age_ticks // 2, exposed + age_ticks)
    if version >= (4, 1):
        payload += struct.pack("<II", 0, 0)
    payload += struct.pack("<hi", 0, 0)
    return struct.pack("<HH", 7, len(payload)) + payload


@pytest.mark.parametrize("version", VERSIONS.values(), ids=VERSIONS)
@pytest.mark.parametrize("empty", [False, True])
def test_every_version_gives_the_body_and_the_clock(version, empty):
    bodies = [
        rigid_body(version),
        rigid_body(version, 4, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), tracked=False),
    ]
    found = parse_frame(frame(version, bodies, empty=empty), version)
    assert [(body.number, body.tracked) for body in found.bodies] == [(3, True), (4, False)]
    assert plane_pose(found.bodies[0], "y") == pytest.approx((1.5, 2.0, 0.7), abs=1e-6)
    assert found.timestamp_s == 12.5
    assert found.sent_ticks - found.exposed_ticks == (50_000 if version >= (3, 0) else 0)


@pytest.mark.parametrize("version", VERSIONS.values(), ids=VERSIONS)
def test_another_library_reads_the_same(version):
    """Use natnet 0.3.0 of PyPI, by other authors; of 4.1 it does not know the precise time in the suffix."""
    library = pytest.importorskip("natnet.data_frame", reason="pip install natnet")
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    datagram = frame(version, [rigid_body(version)])
    buffer = PacketBuffer(datagram)
    buffer.pointer = 4
    theirs = library.DataFrame.read_from_buffer(buffer, Version(*version))
    ours = parse_frame(datagram, version)
    (body,) = theirs.rigid_bodies
    assert (body.id_num, body.pos, body.rot, body.tracking_valid) == (
        ours.bodies[0].number, ours.bodies[0].position, ours.bodies[0].rotation, ours.bodies[0].tracked,
    )  # fmt: skip
    assert theirs.suffix.timestamp == ours.timestamp_s
    assert (theirs.suffix.stamp_camera_mid_exposure or 0) == ours.exposed_ticks
    assert (theirs.suffix.stamp_transmit or 0) == ours.sent_ticks


def test_a_frame_of_motive_as_its_makers_client_showed_it():
    """Motive 2.1, NatNet 3.0: the figures that the tests of mje-nz/python_natnet hold of their recording."""
    position, rotation = (0.1744466, 1.4471314, -0.7343040), (-0.05459423, 0.5099482, 0.04370357, -0.8573577)
    exposed, sent, frequency = 1416497730518, 1416497748722, 3312787
    datagram = frame(
        (3, 0), [rigid_body((3, 0), 2, position, rotation)], timestamp_s=1356.117, exposed=exposed,
        age_ticks=sent - exposed,
    )  # fmt: skip
    found = parse_frame(datagram, (3, 0))
    x_m, y_m, yaw_rad = plane_pose(found.bodies[0], "y")
    # Where the body's own x axis points to, seen from above: Motive's x to the right, its z towards the viewer.
    forward = Rotation.from_quat(rotation).apply((1.0, 0.0, 0.0))
    assert (x_m, y_m) == pytest.approx((0.1744466, 0.7343040))
    assert yaw_rad == pytest.approx(math.atan2(-forward[2], forward[0]), abs=1e-6)
    assert (found.sent_ticks - found.exposed_ticks) / frequency == pytest.approx(0.005495, abs=1e-6)


def test_axes_that_are_z_up_already_stay():
    version = (3, 0)
    rotation = (0.0, 0.0, math.sin(-0.4), math.cos(-0.4))
    found = parse_frame(frame(version, [rigid_body(version, 1, (1.0, -2.0, 0.3), rotation)]), version)
    assert plane_pose(found.bodies[0], "z") == pytest.approx((1.0, -2.0, -0.8), abs=1e-6)


@examples(
    quick=60,
    every=200,
    datagram=st.binary(max_size=300),
    version=st.sampled_from(list(VERSIONS.values())),
    at=st.integers(0, 400),
    change=st.binary(max_size=8),
)
def test_no_bytes_break_it(datagram, version, at, change):
    assert parse_frame(datagram, version) is None or datagram[:2] == b"\x07\x00"
    valid_frame = frame(version, [rigid_body(version)])
    parse_frame(valid_frame[:at] + change + valid_frame[at + len(change) :], version)
    assert parse_frame(valid_frame[: min(at, 60)], version) is None


class Motive:
    """A server of multicast on the loopback, or of unicast that answers who asks."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))

    def send(self, port, *datagrams, group="239.255.42.99"):
        for datagram in datagrams:
            self.socket.sendto(datagram, (group, port))


def test_by_multicast_with_the_exposures_age_and_a_lost_body(create_source, port):
    version, motive = (3, 0), Motive()
    source = create_source("natnet", data_port=port, body=3, position_std_m=0.002, yaw_std_rad=0.004)
    body = rigid_body(version)
    # The clock's frequency shows in half a second of the server's own time.
    motive.send(port, frame(version, [body], timestamp_s=1.0, exposed=TEN_MHZ))
    motive.send(port, frame(version, [body], timestamp_s=2.0, exposed=2 * TEN_MHZ))
    found, messages = receive_until(source, lambda found, _: len(found) == 2)
    assert messages == ["rigid body 3 is tracked"]
    # The first one's age is not known; the second was exposed 5 ms before it was sent.
    assert {pose.received_ns - pose.t_ns for pose in found} == {0, 5_000_000}
    assert (found[1].x_m, found[1].y_m, found[1].yaw_rad) == pytest.approx((1.5, 2.0, 0.7), abs=1e-6)
    assert (found[1].position_std_m, found[1].yaw_std_rad) == (0.002, 0.004)
    unseen = rigid_body(version, tracked=False)
    nan = rigid_body(version, position=(math.nan, 0.1, -2.0))
    motive.send(
        port, frame(version, [unseen]), frame(version, [nan]), frame(version, [unseen]), b"hello", frame(version, [])
    )
    found, messages = receive_until(source, lambda _, messages: len(messages) == 3)
    assert found == []
    assert messages[0] == "the cameras do not see rigid body 3; check its markers"
    assert messages[1] == "datagrams received that are not frames of NatNet 3.0; correct pose.natnet_version"
    assert messages[2] == "rigid body 3 is not in Motive's frames, which have none; correct pose.body"
    assert (source.lost, source.malformed) == (3, 1)
    source.close()
    source.close()
    assert list(source.receive(1, ())) == []


def test_by_unicast_it_asks_and_takes_version_and_clock_from_the_answer(create_source, port, monkeypatch):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(60.0)
        monkeypatch.setattr("drivers.pose.natnet.COMMAND_PORT", server.getsockname()[1])
        source = create_source("natnet", data_port=port, server="127.0.0.1", natnet_version="2.9", body=3)
        assert list(source.receive(0, ())) == []
        connect, client = server.recvfrom(100)
        keep_alive, _ = server.recvfrom(100)
        assert (connect, keep_alive) == (b"\x00\x00\x05\x00Ping\x00", b"\x0a\x00\x01\x00\x00")
        about = (
            b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0, 4, 1, 0, 0]) + struct.pack("<QHB4s", TEN_MHZ, 1511, 0, b"")
        )
        server.sendto(struct.pack("<HH", 1, len(about)) + about, client)
        server.sendto(frame((4, 1), [rigid_body((4, 1))]), client)
        (pose,), _ = receive_until(source, lambda found, _: found)
        assert pose.received_ns - pose.t_ns == 5_000_000
        source.close()


def test_a_server_of_a_newer_version_is_named_once_while_its_frames_are_read(create_source, port):
    version = (3, 0)
    source = create_source("natnet", data_port=port, server="127.0.0.1", body=3)

    def about(*newer):
        text = b"Motive".ljust(256, b"\0") + bytes([9, 9, 0, 0, *newer, 0, 0]) + struct.pack("<Q", TEN_MHZ)
        return struct.pack("<HH", 1, len(text)) + text

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        for answer in (*[about(9, 0)] * 5, about(9, 1)):
            server.sendto(frame(version, [rigid_body(version)]), ("127.0.0.1", port))
            server.sendto(answer, ("127.0.0.1", port))
        _, messages = receive_until(source, lambda _, messages: any("9.1" in text for text in messages))
    supported = ", ".join(VERSIONS)
    assert messages == [
        "rigid body 3 is tracked",
        f"the server uses NatNet 9.0, supported are {supported}",
        f"the server uses NatNet 9.1, supported are {supported}",
    ]


def test_an_address_that_is_not_this_computers_is_one_line():
    with pytest.raises(PoseSourceError, match=r"correct pose\.group, pose\.server, or pose\.address"):
        create_pose_source("natnet", address="203.0.113.7")


def test_frames_of_a_second_server_are_refused_and_named(create_source, port):
    version = (3, 0)
    source = create_source("natnet", data_port=port, server="127.0.0.1", body=3)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as two,
    ):
        for sender, x_m in ((one, 1.0), (two, 5.0), (one, 1.1)):
            sender.sendto(frame(version, [rigid_body(version, position=(x_m, 0.1, -2.0))]), ("127.0.0.1", port))
        names = [f"127.0.0.1:{sender.getsockname()[1]}" for sender in (one, two)]
        found, messages = receive_until(source, lambda found, _: len(found) == 2)
    assert [pose.x_m for pose in found] == pytest.approx([1.0, 1.1])
    assert any(f"{names[1]} sends poses while {names[0]} does: not used" in message for message in messages)


def test_a_frame_with_more_than_motive_can_send_is_none():
    version = (3, 0)
    one = [rigid_body(version)]
    valid_frame = frame(version, one, empty=True)
    # After size, number of the frame and its head: so many marker sets, none of which has a name or a marker.
    sets = b"\0" + struct.pack("<i", 0)
    for many, is_read in ((1000, True), (12_000, False)):
        body = valid_frame[4:8] + struct.pack("<i", many) + many * sets + valid_frame[12:]
        found = parse_frame(struct.pack("<HH", 7, len(body)) + body, version)
        assert (found is not None) == is_read


def test_a_flood_of_long_datagrams_waits_for_the_next_tick(create_source, port):
    source = create_source("natnet", data_port=port, server="127.0.0.1", body=3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(3):
            sender.sendto(bytes(40_000), ("127.0.0.1", port))
    assert list(source.receive(1, ())) == []
    assert source.malformed == 2
    assert list(source.receive(2, ())) == []
    assert source.malformed == 3
