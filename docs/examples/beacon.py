"""Poses in datagrams from another process on this computer.

Each is six little-endian doubles: time (s, monotonic clock), x, y (m), yaw (rad), and the standard deviations of
position (m) and yaw (rad).
"""

import contextlib
import math
import socket
import struct
from collections.abc import Sequence
from typing import Any

from drivers.pose import PoseSourceError
from drivers.types import PoseSample

SOURCE = "beacon"
POSE = struct.Struct("<6d")
MOST_A_TICK = 100


def create_pose_source(*, beacon_port: int = 5005, **_of_other_sources: Any) -> "BeaconPoses":
    """By the fields of [pose]. Raises PoseSourceError for a port that cannot be had."""
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.bind(("127.0.0.1", beacon_port))
    except OSError as error:
        opened.close()
        raise PoseSourceError(f"port {beacon_port}: {error.strerror}; choose another beacon_port") from None
    return BeaconPoses(opened)


class BeaconPoses:
    """Satisfies `drivers.types.PoseSource`."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self.malformed = 0

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return what came since the last call, oldest first; never waits and never raises."""
        poses = []
        with contextlib.suppress(OSError):
            for _ in range(MOST_A_TICK):
                datagram = self._socket.recv(100)
                values = POSE.unpack(datagram) if len(datagram) == POSE.size else (math.nan,)
                if not all(math.isfinite(value) for value in values):
                    self.malformed += 1
                    continue
                t_s, *pose = values
                poses.append(PoseSample(round(t_s * 1e9), now_ns, *pose))
        return poses

    def close(self) -> None:
        self._socket.close()
