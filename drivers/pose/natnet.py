"""Poses of a rigid body from OptiTrack's Motive, by its NatNet datagrams, multicast or unicast.

Layout as NatNet's own SDK documents it, versions 2.6 to 4.1, little-endian. A frame holds marker sets, loose markers,
rigid bodies, skeletons, assets (4.1), labelled markers, force plates, devices, and a suffix with the server's clock.
"""

from __future__ import annotations

import contextlib
import math
import socket
import struct
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from drivers.pose import PoseSourceError
from drivers.pose.senders import SILENCE_S, SenderGate
from drivers.types import PoseSample

SOURCE = "natnet"
# NatNet: Motive's command port, and NAT_CONNECT, NAT_SERVERINFO, NAT_FRAMEOFDATA and NAT_KEEPALIVE of the SDK's
# NatNetTypes.h.
COMMAND_PORT = 1510
CONNECT, SERVER_INFO, FRAME, KEEP_ALIVE = 0, 1, 7, 10
VERSIONS = {text: tuple(int(part) for part in text.split(".")) for text in ("2.6", "2.7", "2.8", "2.9", "2.10", "2.11")}
VERSIONS |= {text: tuple(int(part) for part in text.split(".")) for text in ("3.0", "3.1", "4.0", "4.1")}
# Chosen, as in `drivers.pose.udp`; the longest datagram is UDP's.
_MOST_A_TICK = 100
_LONGEST_DATAGRAM = 65_535
_MOST_BYTES_A_TICK = 65_536
"""After so many bytes the next datagram waits for the next tick: whoever floods the port must not hold up the loop."""
_MOST_ITEMS = 3000
"""In a frame, all kinds together: NatNet's own SDK has room for 1000 of a kind, and more would take milliseconds."""
# Chosen: oftener finds a server that starts later sooner, and sends it more.
_REQUEST_NS = 1_000_000_000
# MAX_NAMELENGTH of NatNetTypes.h.
_NAME_LENGTH = 256
# Chosen: over less, the resolution of the server's seconds shows in the frequency.
_CLOCK_LEAST_S = 0.5
# Chosen: a larger age is of a clock that was misread, and counts as none.
_OLDEST_S = 10.0

Version = tuple[int, ...]


class Body(msgspec.Struct, frozen=True):
    """A rigid body as it is in a frame: position (m) and quaternion (x, y, z, w) in Motive's axes."""

    number: int
    position: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    tracked: bool


class MotiveFrame(msgspec.Struct, frozen=True):
    """The rigid bodies of a frame, and the server's clock: seconds, ticks at exposure and at sending (0 before 3.0)."""

    bodies: tuple[Body, ...]
    timestamp_s: float
    exposed_ticks: int
    sent_ticks: int


class _Reader:
    """Takes one thing after the other from a datagram; struct.error where it is too short."""

    def __init__(self, data: bytes, at: int) -> None:
        self._data, self._at = data, at
        self._items_left = _MOST_ITEMS

    def unpack(self, layout: str) -> tuple[Any, ...]:
        form = struct.Struct("<" + layout)
        values = form.unpack_from(self._data, self._at)
        self._at += form.size
        return values

    def skip(self, size: int) -> None:
        if size < 0 or self._at + size > len(self._data):
            raise struct.error("too short")
        self._at += size

    def skip_marker_set(self) -> None:
        self._at = self._data.index(b"\0", self._at) + 1
        self.skip(12 * self.count())

    def count(self) -> int:
        (value,) = self.unpack("i")
        if not 0 <= value <= len(self._data):
            raise struct.error("a count that cannot be")
        return int(value)

    def expect_items(self, count: int) -> range:
        """Return a range over so many items that are read one by one; struct.error for more than Motive can send."""
        self._items_left -= count
        if self._items_left < 0:
            raise struct.error("more than Motive can send")
        return range(count)


def parse_frame(datagram: bytes, version: Version) -> MotiveFrame | None:
    """Return the frame in a datagram of this version of NatNet; None for what is none."""
    try:
        return _parse(datagram, version)
    except (struct.error, ValueError):
        return None


def _parse(datagram: bytes, version: Version) -> MotiveFrame | None:
    reader = _Reader(datagram, 0)
    kind, size = reader.unpack("HH")
    if kind != FRAME or size > len(datagram) - 4:
        return None
    reader.unpack("i")
    _section(reader, version, reader.skip_marker_set)
    _section(reader, version, lambda: reader.skip(12))
    bodies: list[Body] = []
    _section(reader, version, lambda: bodies.append(_body(reader, version)), always=True)
    _section(
        reader,
        version,
        lambda: (reader.unpack("i"), [_body(reader, version) for _ in reader.expect_items(reader.count())]),
    )
    if version >= (4, 1):
        _section(reader, version, lambda: None)
    _section(reader, version, lambda: reader.skip(22 + 4 * (version >= (3, 0))))
    for since in ((2, 9), (2, 11)):
        if version >= since:
            _section(reader, version, lambda: _channels(reader))
    reader.unpack("II")
    (timestamp_s,) = reader.unpack("d" if version >= (2, 7) else "f")
    exposed_ticks, _, sent_ticks = reader.unpack("QQQ") if version >= (3, 0) else (0, 0, 0)
    if not math.isfinite(timestamp_s):
        return None
    return MotiveFrame(tuple(bodies), timestamp_s, exposed_ticks, sent_ticks)


def _section(reader: _Reader, version: Version, each: Callable[[], object], always: bool = False) -> None:
    """Take a count and so many things; from 4.1 on their size is there, and what is not wanted is passed over."""
    count = reader.count()
    if version >= (4, 1):
        size = reader.count()
        if not always:
            reader.skip(size)
            return
    for _ in reader.expect_items(count):
        each()


def _body(reader: _Reader, version: Version) -> Body:
    number, x, y, z, qx, qy, qz, qw = reader.unpack("i3f4f")
    if version < (3, 0):
        # The body's markers: place, number and size of each.
        reader.skip(20 * reader.count())
    _, flags = reader.unpack("fh")
    return Body(number, (x, y, z), (qx, qy, qz, qw), bool(flags & 1))


def _channels(reader: _Reader) -> None:
    reader.unpack("i")
    for _ in reader.expect_items(reader.count()):
        reader.skip(4 * reader.count())


def plane_pose(body: Body, up_axis: str) -> tuple[float, float, float]:
    """x, y (m) and yaw (rad) of a body on the ground; Motive's y-up axes are turned by a right angle about x."""
    (x, y, z), (qx, qy, qz, qw) = body.position, body.rotation
    if up_axis == "y":
        y, z, qy, qz = -z, y, -qz, qy
    return x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))


def create_pose_source(
    *,
    address: str = "127.0.0.1",
    data_port: int = 1511,
    group: str = "239.255.42.99",
    server: str = "",
    natnet_version: str = "3.0",
    body: int = 1,
    up_axis: str = "y",
    position_std_m: float = 0.02,
    yaw_std_rad: float = 0.02,
    allow: Sequence[str] | None = None,
    sender_silence_s: float = SILENCE_S,
    **_of_other_sources: Any,
) -> NatNetPoses:
    """Create the NatNet source from the fields of [pose].

    Raises PoseSourceError for an address or group that cannot be had.
    """
    senders = SenderGate(sender_silence_s, allow)
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        # Motive's other clients on this computer take the same port.
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((address if server else group, data_port))
        if not server:
            member = socket.inet_aton(group) + socket.inet_aton(address)
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
    except OSError as error:
        opened.close()
        raise PoseSourceError(
            f"{server or group}:{data_port} at {address}: {error.strerror or error}; correct pose.group, pose.server, "
            "or pose.address, which is this computer's in Motive's network"
        ) from None
    settings = (body, up_axis, position_std_m, yaw_std_rad)
    return NatNetPoses(opened, senders, server, VERSIONS[natnet_version], *settings)


class NatNetPoses:
    """Satisfies `drivers.types.PoseSource` and `drivers.types.MessageSource`.

    With a server's address it asks that one once a second, which keeps a server that sends unicast going, and whose
    answer has the version and the clock's frequency.
    """

    def __init__(
        self,
        opened: socket.socket,
        senders: SenderGate,
        server: str,
        version: Version,
        body: int,
        up_axis: str,
        position_std_m: float,
        yaw_std_rad: float,
    ) -> None:
        self._socket, self._senders, self._server = opened, senders, server
        self._version, self._body, self._up_axis = version, body, up_axis
        self._stds = position_std_m, yaw_std_rad
        self._requested_ns: int | None = None
        self._ticks_per_s: float | None = None
        self._first: MotiveFrame | None = None
        self._state = ""
        self._unsupported: Version | None = None
        self._messages: list[str] = []
        self.malformed = self.lost = 0

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the poses received since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(OSError):
            self._request_info(now_ns)
            count = 0
            for _ in range(_MOST_A_TICK):
                if count >= _MOST_BYTES_A_TICK:
                    break
                datagram, sender = self._socket.recvfrom(_LONGEST_DATAGRAM)
                count += len(datagram)
                pose = self._handle(datagram, now_ns) if self._counts(datagram, sender, now_ns) else None
                if pose is not None:
                    self._senders.note_pose(sender, now_ns)
                    poses.append(pose)
        return sorted(poses, key=lambda pose: pose.t_ns)

    def new_messages(self) -> Sequence[str]:
        """Return messages for the operator since the last call."""
        messages, self._messages = self._messages, []
        return [*messages, *self._senders.new_messages()]

    def close(self) -> None:
        """Close the NatNet socket; safe to call twice."""
        self._socket.close()

    def _request_info(self, now_ns: int) -> None:
        if not self._server or (self._requested_ns is not None and now_ns - self._requested_ns < _REQUEST_NS):
            return
        self._requested_ns = now_ns
        for message in (CONNECT, KEEP_ALIVE):
            text = b"Ping\0" if message == CONNECT else b"\0"
            self._socket.sendto(struct.pack("<HH", message, len(text)) + text, (self._server, COMMAND_PORT))

    def _counts(self, datagram: bytes, sender: tuple[str, int], now_ns: int) -> bool:
        """Whether a datagram is looked at: a server describes itself from another port than its frames come from."""
        if datagram[:2] == struct.pack("<H", SERVER_INFO) and sender[0] in (self._server, self._senders.kept_address):
            return True
        return self._senders.may_send(sender, now_ns)

    def _handle(self, datagram: bytes, now_ns: int) -> PoseSample | None:
        if datagram[:2] == struct.pack("<H", SERVER_INFO):
            self._handle_server_info(datagram)
            return None
        frame = parse_frame(datagram, self._version)
        if frame is None:
            self.malformed += 1
            self._note(
                f"datagrams received that are not frames of NatNet {_text(self._version)}; correct pose.natnet_version"
            )
            return None
        body = next((each for each in frame.bodies if each.number == self._body), None)
        if body is None:
            there = ", ".join(str(each.number) for each in frame.bodies) or "none"
            self._note(f"rigid body {self._body} is not in Motive's frames, which have {there}; correct pose.body")
            return None
        if not body.tracked or not all(map(math.isfinite, (*body.position, *body.rotation))):
            self.lost += 1
            self._note(f"the cameras do not see rigid body {self._body}; check its markers")
            return None
        self._note(f"rigid body {self._body} is tracked")
        age_s = self._age_s(frame)
        return PoseSample(now_ns - round(1e9 * age_s), now_ns, *plane_pose(body, self._up_axis), *self._stds)

    def _handle_server_info(self, datagram: bytes) -> None:
        with contextlib.suppress(struct.error):
            version = struct.unpack_from("<4B", datagram, 4 + _NAME_LENGTH + 4)[:2]
            if version in VERSIONS.values():
                self._version = version
            elif version != self._unsupported:
                self._unsupported = version
                self._messages.append(f"the server uses NatNet {_text(version)}, supported are {', '.join(VERSIONS)}")
            if version >= (3, 0):
                (ticks_per_s,) = struct.unpack_from("<Q", datagram, 4 + _NAME_LENGTH + 8)
                self._ticks_per_s = float(ticks_per_s) or None

    def _age_s(self, frame: MotiveFrame) -> float:
        """From the exposure to the sending, by the server's clock, whose frequency its own seconds show."""
        if self._ticks_per_s is None and frame.exposed_ticks:
            first = self._first = self._first or frame
            elapsed_s = frame.timestamp_s - first.timestamp_s
            if elapsed_s >= _CLOCK_LEAST_S:
                self._ticks_per_s = (frame.exposed_ticks - first.exposed_ticks) / elapsed_s
        if not self._ticks_per_s or self._ticks_per_s < 0.0:
            return 0.0
        age_s = (frame.sent_ticks - frame.exposed_ticks) / self._ticks_per_s
        return age_s if 0.0 <= age_s <= _OLDEST_S else 0.0

    def _note(self, sentence: str) -> None:
        if sentence != self._state:
            self._state = sentence
            self._messages.append(sentence)


def _text(version: Version) -> str:
    return ".".join(map(str, version))
