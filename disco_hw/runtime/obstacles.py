"""Obstacles that somebody reports: circles with a velocity, each kept until its age limit.

Reports come from the control socket or in UDP datagrams, from any program that can send one: a tracker, another robot,
the bridge to ROS 2. A datagram is JSON or MessagePack, one obstacle or a list, with the fields of `ObstacleReport`.

An obstacle that is reported no longer is kept where its last velocity takes it. At its age limit it becomes lost: the
robot must then stand still until it is reported again or removed, because nobody knows where it is.
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from disco_hw.config import RobotConfig
from disco_hw.errors import WorkError
from disco_hw.fence.clearance import MovingCircle
from drivers.pose.senders import RefusedDatagrams
from drivers.pose.udp import open_udp_port
from drivers.samples import FARTHEST_M

# Chosen: each takes time of the fence guard and the planner in every tick; further ones are refused.
MOST_OBSTACLES = 32
TOO_MANY = f"there may be {MOST_OBSTACLES}; report the nearest ones"
REPORTED_AGE_LIMIT_S = 1.0
"""Age limit of a report over UDP or ROS 2 that says none."""
ENTERED_AGE_LIMIT_S = 600.0
"""Age limit of an obstacle that a person enters and says none."""
# Chosen: above what moves near such a robot; a report of more is taken for an error of units and refused.
_FASTEST_M_S = 20.0
# Chosen: one for each obstacle that there may be; the rest waits for the next tick, so that no sender holds up the
# loop.
_DATAGRAMS_A_TICK = 32
# Chosen: room for MOST_OBSTACLES reports with short numbers as JSON; a longer datagram is cut off and counts as
# malformed.
_LONGEST_DATAGRAM = 8192
_Coordinate = Annotated[float, Meta(ge=-FARTHEST_M, le=FARTHEST_M)]
_Speed = Annotated[float, Meta(ge=-_FASTEST_M_S, le=_FASTEST_M_S)]


class ObstacleReport(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Report of one obstacle: centre and radius (m) and velocity (m/s) in the pose frame, `age_s` ago.

    `age_limit_s`: how long the report may be relied on. `removed`: the obstacle is gone, and the robot need not stop.
    """

    name: Annotated[str, Meta(min_length=1, max_length=32, pattern=r"^[A-Za-z0-9_.-]+$")]
    x_m: _Coordinate
    y_m: _Coordinate
    radius_m: Annotated[float, Meta(gt=0.0, le=FARTHEST_M)]
    vx_m_s: _Speed = 0.0
    vy_m_s: _Speed = 0.0
    age_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.0
    age_limit_s: Annotated[float, Meta(gt=0.0, le=86400.0)] = REPORTED_AGE_LIMIT_S
    removed: bool = False


class ObstacleRefused(Exception):  # noqa: N818
    """The obstacle is not taken; the message says why and what to do."""


def report_from(fields: Mapping[str, Any], age_limit_s: float = REPORTED_AGE_LIMIT_S) -> ObstacleReport:
    """Return the report that these fields make; `age_limit_s` where they say none. Raises ObstacleRefused."""
    try:
        report = msgspec.convert({"age_limit_s": age_limit_s, **fields}, ObstacleReport)
    except msgspec.ValidationError as error:
        example = "name=pillar x_m=0.5 y_m=0 radius_m=0.15"
        raise ObstacleRefused(f"obstacle: {str(error).replace('`', '')}; write it as {example}") from None
    if not _is_finite(report):
        raise ObstacleRefused("obstacle: not a finite number; write finite values")
    return report


def _is_finite(report: ObstacleReport) -> bool:
    return all(math.isfinite(value) for value in msgspec.structs.astuple(report) if isinstance(value, float))


@dataclass(frozen=True, slots=True)
class _Kept:
    report: ObstacleReport
    true_ns: int

    def age_s(self, now_ns: int) -> float:
        return max(0, now_ns - self.true_ns) * 1e-9

    def now(self, now_ns: int) -> MovingCircle:
        one, age_s = self.report, self.age_s(now_ns)
        return MovingCircle(
            one.x_m + one.vx_m_s * age_s, one.y_m + one.vy_m_s * age_s, one.radius_m, one.vx_m_s, one.vy_m_s
        )


class Obstacles:
    """The obstacles that are known, by name."""

    def __init__(self) -> None:
        self._kept: dict[str, _Kept] = {}
        self._missing: frozenset[str] = frozenset()

    def report(self, now_ns: int, report: ObstacleReport) -> None:
        """Take in a report, in place of an earlier one of the same name. Raises ObstacleRefused if there are 32."""
        if report.name not in self._kept and len(self._kept) >= MOST_OBSTACLES:
            raise ObstacleRefused(f"obstacle {report.name}: there are {MOST_OBSTACLES} already; remove one first")
        self._kept[report.name] = _Kept(report, now_ns - round(report.age_s * 1e9))

    def remove(self, name: str) -> None:
        """Remove an obstacle by its name. Raises ObstacleRefused if there is none of that name."""
        if name not in self._kept:
            known = ", ".join(sorted(self._kept)) or "none"
            raise ObstacleRefused(f"obstacle {name}: not known; known obstacles: {known}")
        del self._kept[name]

    def step(self, now_ns: int) -> tuple[str, ...]:
        """Update which obstacles are lost; return a sentence for each whose reports have ceased or are back."""
        missing = frozenset(name for name, one in self._kept.items() if one.age_s(now_ns) > one.report.age_limit_s)
        gone, back = sorted(missing - self._missing), sorted((self._missing - missing) & self._kept.keys())
        self._missing = missing
        limits = {name: self._kept[name].report.age_limit_s for name in gone}
        messages = [f"fence: obstacle {name} not reported for {limits[name]:g} s; the robot stops" for name in gone]
        return (*messages, *(f"fence: obstacle {name} is reported again" for name in back))

    @property
    def lost(self) -> tuple[str, ...]:
        """Names of the obstacles whose reports had ceased at the last step."""
        return tuple(sorted(self._missing & self._kept.keys()))

    def circles(self, now_ns: int) -> tuple[MovingCircle, ...]:
        """Return the obstacles as moving circles, at their places now."""
        return tuple(one.now(now_ns) for one in self._kept.values())

    def status(self, now_ns: int) -> list[dict[str, Any]]:
        """Return each obstacle's status: where it is now, and the age of its report."""
        return [
            {
                "name": name,
                **asdict(one.now(now_ns)),
                "age_s": one.age_s(now_ns),
                "age_limit_s": one.report.age_limit_s,
                "lost": name in self._missing,
            }
            for name, one in sorted(self._kept.items())
        ]


_Content = ObstacleReport | list[ObstacleReport]
_JSON = msgspec.json.Decoder(_Content)
_MESSAGE_PACK = msgspec.msgpack.Decoder(_Content)


def obstacle_source_of(config: RobotConfig) -> UdpObstacles | None:
    """Open the port that robot.toml names for reports; None without one. Raises WorkError if it cannot be had."""
    port = config.fence.obstacles_port
    if port is None:
        return None
    address = config.fence.obstacles_address
    try:
        return UdpObstacles(open_udp_port(address, port))
    except OSError as error:
        why = error.strerror or str(error)
        raise WorkError(f"robot.toml: fence.obstacles_port: {address}:{port}: {why}; choose another port") from None


class UdpObstacles:
    """Source of obstacle reports in UDP datagrams, for the control loop: no call waits, and its work is bounded."""

    def __init__(self, opened: socket.socket) -> None:
        self._socket = opened
        self.refused = RefusedDatagrams()

    def receive(self, now_ns: int) -> Sequence[ObstacleReport]:
        """Return the obstacles reported since the last call, oldest first; never waits and never raises."""
        reports: list[ObstacleReport] = []
        with contextlib.suppress(OSError):
            for _ in range(_DATAGRAMS_A_TICK):
                datagram, (address, port) = self._socket.recvfrom(_LONGEST_DATAGRAM)
                try:
                    found = reports_in(datagram)
                except ObstacleRefused as refused:
                    self.refused.add(now_ns, f"{address}:{port} sends {refused}", "docs/fence.md shows a report")
                    continue
                reports += found[:MOST_OBSTACLES]
                for surplus in found[MOST_OBSTACLES:]:
                    self.refused.add(now_ns, f"obstacle {surplus.name} from {address}:{port}", TOO_MANY)
        return reports

    def close(self) -> None:
        """Close the UDP socket; safe to call twice."""
        self._socket.close()


def reports_in(datagram: bytes) -> list[ObstacleReport]:
    """Return the reports in a datagram. Raises ObstacleRefused for what holds none, or one that is not right."""
    decoder = _JSON if datagram[:1] in (b"{", b"[") else _MESSAGE_PACK
    try:
        read = decoder.decode(datagram)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ObstacleRefused(f"what is no report of obstacles ({str(error)[:80]})") from None
    reports = read if isinstance(read, list) else [read]
    if not all(map(_is_finite, reports)):
        raise ObstacleRefused("an obstacle with a number that is not finite")
    return reports
