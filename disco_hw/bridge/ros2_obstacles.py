"""Obstacles from ROS 2: a message as the datagrams that `fence.obstacles_port` takes, or why it is none; pure.

Two types are read from the topic: an array of obstacles as costmap_converter and the TEB planner use it, and text with
the JSON that goes over UDP, for a sender that has the standard messages alone.

An id names an obstacle if it is positive and the only one in its array. Obstacles with other ids (costmap_converter
leaves 0, or writes -1) are numbered; those that the sender's next array lacks are gone, as it holds all that is seen.
What a bridge before this one numbered is taken over from the daemon.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence

import msgspec

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2_inlets import AHEAD_NS
from disco_hw.runtime.obstacles import MOST_OBSTACLES, ObstacleRefused, ObstacleReport, reports_in

TOPIC = "disco_hw/obstacles"
TYPES = (msg.ObstacleArrayMsg, msg.String)
# Chosen: as REPORTED_AGE_LIMIT_S, after which a report holds no longer.
_OLDEST_NS = 1_000_000_000
# Chosen: a removal is repeated for so long, as a datagram can be lost.
_REMOVAL_NS = 2_000_000_000
# Chosen: far above MOST_OBSTACLES; senders with ever new ids must not fill the memory.
_MOST_UNNAMED = 1000
_NAME = re.compile(r"ros2\.(-?\d+)(?:\.(\d+))?")
# Stands for the publishers that a bridge before this one received.
_BEFORE = "before"


class ObstacleInlet:
    """Makes datagrams of obstacles that ROS 2 reports, and counts what it refuses by its reason.

    `frame`: in which poses and fence are; what comes in another is refused.
    """

    def __init__(self, frame: str) -> None:
        self.refused: Counter[str] = Counter()
        self.passed = 0
        """Number of obstacles passed on."""
        self._frame = frame.lstrip("/")
        self._unnamed: dict[tuple[int, int], tuple[Hashable, int]] = {}
        """Publisher and time of the last report of each numbered obstacle, by its id and number."""
        self._first_ns: dict[Hashable, int] = {}
        """When each publisher's first whole array came."""

    def datagrams(
        self,
        message: msg.ObstacleArrayMsg | msg.String,
        sent_ns: int,
        mono_ns: int,
        wall_ns: int,
        publisher: Hashable = None,
    ) -> list[bytes]:
        """Return the datagrams to send for a message received now, one for each obstacle and each that is gone.

        `sent_ns`, `wall_ns`: when it was sent and received, by the wall clock. The first counts where the message has
        no stamp. `publisher`: who sent it; no other says that its numbered obstacles are gone, but
        one that came when it was silent: a sender that restarts is another publisher.
        """
        gone: Sequence[ObstacleReport] = ()
        if isinstance(message, msg.String):
            reports = self._in_text(message)
        else:
            reports = self._in_array(message, sent_ns, wall_ns)
            gone = self._gone_since(message, sent_ns, mono_ns, wall_ns, publisher)
        self.passed += len(reports)
        return [msgspec.json.encode(one) for one in (*reports, *gone)]

    def take_over(self, ages_s: Mapping[str, float], mono_ns: int) -> None:
        """Take over the numbered obstacles of a bridge before this one: all obstacles by name, with their age in s."""
        for name, age_s in ages_s.items():
            found = _NAME.fullmatch(name)
            if found is None:
                continue
            number, k = int(found[1]), int(found[2] or 1)
            if number <= 0 or k > 1 or _name(number, 2) in ages_s:
                self._unnamed[number, k] = _BEFORE, mono_ns - round(age_s * 1e9)

    def _in_text(self, message: msg.String) -> Sequence[ObstacleReport]:
        try:
            reports = reports_in(message.data.encode())
        except ObstacleRefused:
            self.refused["text that is not the JSON of docs/fence.md"] += 1
            return ()
        self._count_surplus(len(reports))
        return reports[:MOST_OBSTACLES]

    def _in_array(self, message: msg.ObstacleArrayMsg, sent_ns: int, wall_ns: int) -> Sequence[ObstacleReport]:
        reports: list[ObstacleReport] = []
        numbers: Counter[int] = Counter()
        for one in message.obstacles[:MOST_OBSTACLES]:
            numbers[one.id] += 1
            age_ns, refusal = self._age_of(one, message, sent_ns, wall_ns)
            if refusal:
                self.refused[refusal] += 1
            elif (found := _report_of(one, _name(one.id, numbers[one.id]), max(0, age_ns) * 1e-9)) is None:
                self.refused["without a place, too large, too fast or not finite"] += 1
            else:
                reports.append(found)
        self._count_surplus(len(message.obstacles))
        return reports

    def _age_of(
        self, one: msg.ObstacleMsg, message: msg.ObstacleArrayMsg, sent_ns: int, wall_ns: int
    ) -> tuple[int, str]:
        """Return the age of an obstacle in an array, and why its frame or age is refused, empty if it is not."""
        frame = (one.header.frame_id or message.header.frame_id).lstrip("/")
        age_ns = wall_ns - (msg.time_of(one.header.stamp) or msg.time_of(message.header.stamp) or sent_ns)
        if frame != self._frame:
            hint = "" if frame else "; have the sender fill in header.frame_id"
            return age_ns, f'in frame "{frame[:40]}", not "{self._frame}"{hint}'
        if not -AHEAD_NS <= age_ns <= _OLDEST_NS:
            return age_ns, "stamped by another clock, or over 1 s late; synchronise the clocks"
        return age_ns, ""

    def _gone_since(
        self, message: msg.ObstacleArrayMsg, sent_ns: int, mono_ns: int, wall_ns: int, publisher: Hashable
    ) -> list[ObstacleReport]:
        """Return a removal of each numbered obstacle of this publisher that its array lacks; none for a refused one."""
        # An empty array is of its header's frame and time.
        if any(self._age_of(one, message, sent_ns, wall_ns)[1] for one in message.obstacles or [msg.ObstacleMsg()]):
            return []
        first_ns = self._first_ns.setdefault(publisher, mono_ns)
        for key, (_, reported_ns) in self._unnamed.items():
            if reported_ns < first_ns and mono_ns - reported_ns > _OLDEST_NS:
                self._unnamed[key] = (publisher, mono_ns)
        counts = Counter(one.id for one in message.obstacles)
        gone = [key for key, (sender, _) in self._unnamed.items() if sender == publisher and key[1] > counts[key[0]]]
        for key in gone:
            if mono_ns - self._unnamed[key][1] > _REMOVAL_NS:
                del self._unnamed[key]
        if len(self._unnamed) > _MOST_UNNAMED:
            self._unnamed.clear()
        if len(self._first_ns) > _MOST_UNNAMED:
            self._first_ns.clear()
        for number, count in counts.items():
            if number <= 0 or count > 1 or (number, 1) in self._unnamed:
                reported = range(1, min(count, MOST_OBSTACLES) + 1)
                self._unnamed.update({(number, k): (publisher, mono_ns) for k in reported})
        return [
            ObstacleReport(name=_name(number, k), x_m=0.0, y_m=0.0, radius_m=1.0, removed=True) for number, k in gone
        ]

    def _count_surplus(self, count: int) -> None:
        if count > MOST_OBSTACLES:
            self.refused[f"more than {MOST_OBSTACLES} in a message"] += count - MOST_OBSTACLES


def _name(number: int, k: int) -> str:
    """Return the name of the k-th obstacle with this id in its array."""
    return f"ros2.{number}" if k == 1 else f"ros2.{number}.{k}"


def _report_of(one: msg.ObstacleMsg, name: str, age_s: float) -> ObstacleReport | None:
    """Return the circle around an obstacle's points, each with the obstacle's radius; None for what makes none."""
    points = [(float(point.x), float(point.y)) for point in one.polygon.points]
    if not points:
        return None
    x_m, y_m = (0.5 * (min(axis) + max(axis)) for axis in zip(*points, strict=True))
    # In this order, so that a radius that is no number stays none.
    radius_m = max(one.radius, 0.0) + max(math.hypot(x - x_m, y - y_m) for x, y in points)
    velocity = one.velocities.twist.linear
    fields = {
        "name": name, "x_m": x_m, "y_m": y_m,
        # A point has no size; the smallest circle stands for it.
        "radius_m": radius_m if radius_m != 0.0 else 1e-3,
        "vx_m_s": velocity.x, "vy_m_s": velocity.y, "age_s": age_s,
    }  # fmt: skip
    try:
        return reports_in(msgspec.msgpack.encode(fields))[0]
    except ObstacleRefused:
        return None
