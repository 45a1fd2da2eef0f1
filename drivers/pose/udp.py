"""Poses in UDP datagrams, one each, JSON or MessagePack, from any program that can send one.

A map with `x_m`, `y_m`, `yaw_rad`, `position_std_m`, `yaw_std_rad`, and when it was true: `age_s` before it was sent,
or `t_ns` on this computer's monotonic clock. `yaw_rad` and `yaw_std_rad` are both left out, or null, where there
is no heading.
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from drivers.pose import PoseSourceError
from drivers.types import PoseSample

SOURCE = "udp"
MOST_A_TICK = 100
LONGEST_DATAGRAM = 1024
OLDEST_S = 10.0


class _Datagram(msgspec.Struct, frozen=True):
    x_m: float
    y_m: float
    position_std_m: float
    yaw_rad: float | None = None
    yaw_std_rad: float | None = None
    age_s: float | None = None
    t_ns: int | None = None


_DECODERS: tuple[Callable[[bytes], _Datagram], ...] = (
    msgspec.json.Decoder(_Datagram).decode,
    msgspec.msgpack.Decoder(_Datagram).decode,
)


def make_pose_source(*, address: str = "127.0.0.1", port: int = 5005, **_of_other_sources: Any) -> UdpPoses:
    """By the fields of [pose]. Raises PoseSourceError for an address that cannot be had."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.bind((address, port))
    except OSError as error:
        opened.close()
        reason = error.strerror or str(error)
        raise PoseSourceError(f"{address}:{port}: {reason}; choose another pose.port, or pose.address") from None
    return UdpPoses(opened)


class UdpPoses:
    """Satisfies `drivers.types.PoseSource`."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self.malformed = 0

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """What came since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(OSError):
            for _ in range(MOST_A_TICK):
                pose = pose_of(self._socket.recv(LONGEST_DATAGRAM), now_ns)
                if pose is None:
                    self.malformed += 1
                else:
                    poses.append(pose)
        return sorted(poses, key=lambda pose: pose.t_ns)

    def close(self) -> None:
        """Close the socket; safe to call twice."""
        self._socket.close()


def pose_of(datagram: bytes, now_ns: int) -> PoseSample | None:
    """Return the pose in a datagram; None for what is none, or has no time in the last ten seconds."""
    is_json = datagram[:1] == b"{"
    try:
        read = _DECODERS[not is_json](datagram)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return None
    if read.age_s is not None and math.isfinite(read.age_s):
        t_ns = now_ns - round(1e9 * read.age_s) if 0.0 <= read.age_s <= OLDEST_S else None
    else:
        t_ns = read.t_ns
    position = (read.x_m, read.y_m, read.position_std_m)
    if t_ns is None or not 0 <= now_ns - t_ns <= OLDEST_S * 1e9 or not all(map(math.isfinite, position)):
        return None
    if read.yaw_rad is None and read.yaw_std_rad is None:
        yaw_rad = yaw_std_rad = math.nan
    elif read.yaw_rad is None or read.yaw_std_rad is None:
        return None
    else:
        yaw_rad, yaw_std_rad = read.yaw_rad, read.yaw_std_rad
        if not (math.isfinite(yaw_rad) and math.isfinite(yaw_std_rad)) or yaw_std_rad < 0.0:
            return None
    if read.position_std_m < 0.0:
        return None
    return PoseSample(t_ns, now_ns, read.x_m, read.y_m, yaw_rad, read.position_std_m, yaw_std_rad)
