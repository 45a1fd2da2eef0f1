"""Obstacles from ROS 2: a message as the datagrams that `fence.obstacles_port` takes, or why it is none; pure.

Two types are read from the topic: an array of obstacles as costmap_converter and the TEB planner use it, and text with
the JSON that goes over UDP, for a sender that has the standard messages alone.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import msgspec

from disco_hw.bridge import ros2_messages as msg
from disco_hw.bridge.ros2_inlets import AHEAD_NS
from disco_hw.runtime.obstacles import MOST_OBSTACLES, ObstacleRefused, ObstacleReport, reports_in

TOPIC = "disco_hw/obstacles"
TYPES = (msg.ObstacleArrayMsg, msg.String)
# Chosen: as REPORTED_AGE_LIMIT_S, after which a report holds no longer.
_OLDEST_NS = 1_000_000_000


class ObstacleInlet:
    """Makes datagrams of obstacles that ROS 2 reports, and counts what it refuses by its reason.

    `frame`: in which poses and fence are; what comes in another is refused.
    """

    def __init__(self, frame: str) -> None:
        self.refused: Counter[str] = Counter()
        self.passed = 0
        """Number of obstacles passed on."""
        self._frame = frame.lstrip("/")

    def datagrams(self, message: msg.ObstacleArrayMsg | msg.String, sent_ns: int, wall_ns: int) -> list[bytes]:
        """Return the datagrams to send for a message received now, one for each obstacle.

        `sent_ns`, `wall_ns`: when it was sent and received, by the wall clock. The first counts where the message has
        no stamp.
        """
        reports = (
            self._in_text(message) if isinstance(message, msg.String) else self._in_array(message, sent_ns, wall_ns)
        )
        self.passed += len(reports)
        return [msgspec.json.encode(one) for one in reports]

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
        for one in message.obstacles[:MOST_OBSTACLES]:
            frame = (one.header.frame_id or message.header.frame_id).lstrip("/")
            stamp_ns = msg.time_of(one.header.stamp) or msg.time_of(message.header.stamp) or sent_ns
            age_ns = wall_ns - stamp_ns
            if frame != self._frame:
                self.refused[f'in frame "{frame[:40]}", not "{self._frame}"'] += 1
            elif not -AHEAD_NS <= age_ns <= _OLDEST_NS:
                self.refused["stamped by another clock, or over 1 s late; synchronise the clocks"] += 1
            elif (found := _report_of(one, max(0, age_ns) * 1e-9)) is None:
                self.refused["without a place, too large, too fast or not finite"] += 1
            else:
                reports.append(found)
        self._count_surplus(len(message.obstacles))
        return reports

    def _count_surplus(self, count: int) -> None:
        if count > MOST_OBSTACLES:
            self.refused[f"more than {MOST_OBSTACLES} in a message"] += count - MOST_OBSTACLES


def _report_of(one: msg.ObstacleMsg, age_s: float) -> ObstacleReport | None:
    """Return the circle around an obstacle's points, each with the obstacle's radius; None for what makes none."""
    points = [(float(point.x), float(point.y)) for point in one.polygon.points]
    if not points:
        return None
    x_m, y_m = (0.5 * (min(axis) + max(axis)) for axis in zip(*points, strict=True))
    # In this order, so that a radius that is no number stays none.
    radius_m = max(one.radius, 0.0) + max(math.hypot(x - x_m, y - y_m) for x, y in points)
    velocity = one.velocities.twist.linear
    fields = {
        "name": f"ros2.{one.id}", "x_m": x_m, "y_m": y_m,
        # A point has no size; the smallest circle stands for it.
        "radius_m": radius_m if radius_m != 0.0 else 1e-3,
        "vx_m_s": velocity.x, "vy_m_s": velocity.y, "age_s": age_s,
    }  # fmt: skip
    try:
        return reports_in(msgspec.msgpack.encode(fields))[0]
    except ObstacleRefused:
        return None
