"""Poses in UDP datagrams, one each, JSON or MessagePack, from any program that can send one.

A map with `x_m`, `y_m`, `yaw_rad`, `position_std_m`, `yaw_std_rad`, and when it was true: `age_s` before it was sent,
or `t_ns` on this computer's monotonic clock. `yaw_rad` and `yaw_std_rad` are both left out, or null, where there
is no heading; a heading whose standard deviation says that it is not known is left out here. One sender is kept to at a
time; with a key each datagram must be proven (`drivers.pose.senders`).
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from drivers.pose import PoseSourceError, is_heading_filled_in
from drivers.pose.senders import SILENCE_S, PoseProof, SenderGate
from drivers.types import PoseSample

SOURCE = "udp"
# Chosen: far above any sensor's rate; who floods the port must not hold up the loop.
MOST_A_TICK = 100
# Chosen: above any pose as JSON; a longer one is cut off and counts as malformed.
LONGEST_DATAGRAM = 1024
# Chosen: longer than any sensor's delay; an older pose is of a clock that is not synchronised.
OLDEST_S = 10.0
# Chosen: above any place on earth in millimetres, and small enough to be squared.
LARGEST = 1e12
POSE_HINT = "docs/poses.md shows what a sender sends"


class _Datagram(msgspec.Struct, frozen=True):
    x_m: float
    y_m: float
    position_std_m: float
    yaw_rad: float | None = None
    yaw_std_rad: float | None = None
    age_s: float | None = None
    t_ns: Annotated[int, Meta(ge=0, le=2**63 - 1)] | None = None


class _Message(msgspec.Struct, frozen=True):
    """A sentence for the operator, from a process of ours that sends poses."""

    said: str


_MESSAGE = msgspec.json.Decoder(_Message)
_DECODERS: tuple[Callable[[bytes], _Datagram], ...] = (
    msgspec.json.Decoder(_Datagram).decode,
    msgspec.msgpack.Decoder(_Datagram).decode,
)


def open_udp_port(address: str, port: int) -> socket.socket:
    """Return a UDP socket for the control loop, which receives on this port and never waits. Raises OSError."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.bind((address, port))
    except OSError:
        opened.close()
        raise
    return opened


def create_pose_source(
    *,
    address: str = "127.0.0.1",
    port: int = 5005,
    allow: Sequence[str] | None = None,
    key_file: str = "",
    key: bytes | None = None,
    sender_silence_s: float = SILENCE_S,
    **_of_other_sources: Any,
) -> UdpPoses:
    """Create the UDP source from the fields of [pose], and the `key` that the host has read from `key_file`.

    Raises PoseSourceError for an address that cannot be had, and for a key that is named and not given.
    """
    if key_file and key is None:
        raise PoseSourceError(f"the key of {key_file} was not read; poses without authentication would be accepted")
    try:
        opened = open_udp_port(address, port)
    except OSError as error:
        reason = error.strerror or str(error)
        raise PoseSourceError(f"{address}:{port}: {reason}; choose another pose.port, or pose.address") from None
    proof = None if key is None else PoseProof(key, time.time_ns())
    return UdpPoses(opened, SenderGate(sender_silence_s, allow), proof)


class UdpPoses:
    """Satisfies `drivers.types.PoseSource` and `drivers.types.MessageSource`."""

    def __init__(self, opened: socket.socket, senders: SenderGate, proof: PoseProof | None = None) -> None:
        self._socket = opened
        self._senders = senders
        self._proof = proof

    @property
    def refused(self) -> int:
        """Number of datagrams refused for their sender, for want of a proof, or because they hold no pose."""
        return self._senders.refused.count

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the poses received since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(OSError):
            for _ in range(MOST_A_TICK):
                pose = self._handle(*self._socket.recvfrom(LONGEST_DATAGRAM), now_ns)
                if pose is not None:
                    poses.append(pose)
        return sorted(poses, key=lambda pose: pose.t_ns)

    def new_messages(self) -> Sequence[str]:
        """Return messages for the operator since the last call."""
        return self._senders.new_messages()

    def close(self) -> None:
        """Close the UDP socket; safe to call twice."""
        self._socket.close()

    def _handle(self, datagram: bytes, sender: tuple[str, int], now_ns: int) -> PoseSample | None:
        """Return the pose in a datagram, if its sender counts; the cheap checks first, as anybody can send many."""
        if not self._senders.may_send(sender, now_ns):
            return None
        if self._proof is not None:
            opened = self._proof.unwrap(datagram, time.time_ns())
            if isinstance(opened, str):
                text = f"{sender[0]}:{sender[1]} sends poses {opened}"
                self._senders.refused.add(now_ns, text, "docs/poses.md describes what a sender with a key sends")
                return None
            datagram = opened
        pose = pose_of(datagram, now_ns, time.monotonic_ns())
        if isinstance(pose, str):
            self._senders.refused.add(now_ns, f"{sender[0]}:{sender[1]} sends no pose but {pose}", POSE_HINT)
            return None
        self._senders.note_pose(sender, now_ns)
        return pose


def pose_of(datagram: bytes, now_ns: int, read_ns: int = 0) -> PoseSample | str:
    """Return the pose in a datagram, or in words what is there instead.

    `now_ns` is the tick's time, from which `age_s` counts; `read_ns` is when the datagram was read, if later: its
    sender may have stamped it while the tick was already running.
    """
    is_json = datagram[:1] == b"{"
    try:
        read = _DECODERS[not is_json](datagram)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        return f"what cannot be read as one ({str(error)[:80]})"
    is_place = abs(read.x_m) <= LARGEST and abs(read.y_m) <= LARGEST
    if not is_place or not 0.0 <= read.position_std_m <= LARGEST:
        return "a position or a standard deviation that cannot be"
    if read.age_s is not None and math.isfinite(read.age_s):
        age_s = read.age_s
    elif read.t_ns is not None:
        now_ns = max(now_ns, min(read.t_ns, read_ns))
        age_s = (now_ns - read.t_ns) * 1e-9
    else:
        return "a position without age_s or t_ns"
    if not 0.0 <= age_s <= OLDEST_S:
        return f"one that is {age_s:.3g} s old by this computer's clock, not 0 to {OLDEST_S:g} s"
    if (read.yaw_rad is None) != (read.yaw_std_rad is None):
        return "half a heading: yaw_rad and yaw_std_rad go together"
    yaw_rad = math.nan if read.yaw_rad is None else read.yaw_rad
    yaw_std_rad = math.nan if read.yaw_std_rad is None else read.yaw_std_rad
    if not is_heading_filled_in(yaw_rad, yaw_std_rad) or max(abs(yaw_rad), yaw_std_rad) > LARGEST:
        yaw_rad = yaw_std_rad = math.nan
    t_ns = now_ns - round(1e9 * age_s)
    return PoseSample(t_ns, now_ns, read.x_m, read.y_m, yaw_rad, read.position_std_m, yaw_std_rad)


def message_of(datagram: bytes) -> str | None:
    """Return the sentence for the operator in a datagram of a process of ours; None where there is none."""
    try:
        return _MESSAGE.decode(datagram).said
    except (msgspec.MsgspecError, UnicodeDecodeError):
        return None
