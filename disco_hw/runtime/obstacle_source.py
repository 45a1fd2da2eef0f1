"""Obstacles in UDP datagrams, from any program that can send one: a tracker, another robot, the bridge to ROS 2.

JSON or MessagePack, one obstacle each or a list of them, with the fields of `obstacles.ObstacleReport`. Polled from the
control loop: no call waits, and the work of one poll is bounded.
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Sequence

import msgspec

from disco_hw.config import RobotConfig
from disco_hw.errors import InputError
from disco_hw.runtime.core import NoObstacles, ObstacleSource
from disco_hw.runtime.obstacles import MOST_OBSTACLES, ObstacleReport

# Chosen: one for each obstacle that there may be; the rest waits for the next tick, so that no sender holds up the
# loop.
_DATAGRAMS_A_TICK = 32
# Chosen: room for MOST_OBSTACLES reports with short numbers as JSON; a longer datagram is cut off and counts as
# malformed.
_LONGEST_DATAGRAM = 8192
_Content = ObstacleReport | list[ObstacleReport]
_JSON = msgspec.json.Decoder(_Content)
_MESSAGE_PACK = msgspec.msgpack.Decoder(_Content)


def obstacle_source_of(config: RobotConfig) -> ObstacleSource:
    """Return what robot.toml says of obstacles. Raises InputError for an address that cannot be had."""
    port = config.fence.obstacles_port
    if port is None:
        return NoObstacles()
    address = config.fence.obstacles_address
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.setblocking(False)
    try:
        opened.bind((address, port))
    except OSError as error:
        opened.close()
        why = error.strerror or str(error)
        raise InputError(f"robot.toml: fence.obstacles_port: {address}:{port}: {why}; choose another port") from None
    return UdpObstacles(opened)


class UdpObstacles:
    """Source of obstacle reports that come as UDP datagrams (a `core.ObstacleSource`)."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self.malformed = 0
        """Number of datagrams that held no report."""

    def receive(self, now_ns: int) -> Sequence[ObstacleReport]:
        """Return the obstacles reported since the last call, oldest first; never waits and never raises."""
        reports: list[ObstacleReport] = []
        with contextlib.suppress(OSError):
            for _ in range(_DATAGRAMS_A_TICK):
                found = reports_in(self._socket.recv(_LONGEST_DATAGRAM))
                self.malformed += not found
                reports += found
        return reports

    def close(self) -> None:
        """Close the UDP socket; safe to call twice."""
        self._socket.close()


def reports_in(datagram: bytes) -> list[ObstacleReport]:
    """Return the reports in a datagram, at most 32; empty for what holds none or one that is not right."""
    decoder = _JSON if datagram[:1] in (b"{", b"[") else _MESSAGE_PACK
    try:
        read = decoder.decode(datagram)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return []
    reports = read if isinstance(read, list) else [read]
    numbers = (value for one in reports for value in msgspec.structs.astuple(one) if isinstance(value, float))
    return reports[:MOST_OBSTACLES] if all(map(math.isfinite, numbers)) else []
