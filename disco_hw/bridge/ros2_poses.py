"""What the bridge hears of poses: a message of ROS 2 as a datagram for the daemon, or why it is none; pure.

A message's stamp is wall-clock time, the daemon's time is monotonic: an age says the same in both.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import msgspec

from disco_hw.bridge import ros2_messages as msg
from disco_hw.config import PoseInput

TYPES = (msg.PoseStamped, msg.PoseWithCovarianceStamped, msg.Odometry)
PoseMessage = msg.PoseStamped | msg.PoseWithCovarianceStamped | msg.Odometry
# Clocks of two computers differ, and some transforms are dated ahead; further ahead the stamp is of another clock.
_AHEAD_NS = 50_000_000
_OLDEST_NS = 1_000_000_000
_SHORTEST_NS = 4_000_000
_UNIT_MARGIN = 0.02


class PoseInlet:
    """Judges poses and counts what it refuses, by reason."""

    def __init__(self, settings: PoseInput) -> None:
        self.refused: Counter[str] = Counter()
        self.passed = 0
        self.why = ""
        self._settings = settings
        self._newest_ns = self._passed_ns = -_OLDEST_NS

    def datagram(self, message: PoseMessage, sent_ns: int, mono_ns: int, wall_ns: int) -> bytes | None:
        """The datagram to send for a message heard now; None for what is not to be passed on.

        `sent_ns`: when it was sent, by the sender's wall clock, which counts where the message has no stamp. Of a flood
        one pose in 4 ms is passed on, as a daemon has no use for more.
        """
        reason, pose = self._judge(message, sent_ns, mono_ns, wall_ns)
        if pose is None:
            self.refused[reason] += 1
            self.why = reason
            return None
        self.passed += 1
        self.why = ""
        return msgspec.msgpack.encode(pose)

    def _judge(
        self, message: PoseMessage, sent_ns: int, mono_ns: int, wall_ns: int
    ) -> tuple[str, dict[str, float] | None]:
        wanted = self._settings
        frame = message.header.frame_id.lstrip("/")
        if frame != wanted.frame.lstrip("/"):
            return f'in frame "{frame[:40]}", not pose.frame "{wanted.frame}"', None
        age_ns = wall_ns - (msg.time_of(message.header.stamp) or sent_ns)
        if not -_AHEAD_NS <= age_ns <= _OLDEST_NS:
            return "stamped by another clock, or too late; synchronise the clocks and leave use_sim_time off", None
        t_ns = mono_ns - max(0, age_ns)
        if t_ns <= self._newest_ns:
            return "not newer than the one before", None
        if mono_ns - self._passed_ns < _SHORTEST_NS:
            return "more than 250 a second", None
        pose = message.pose if isinstance(message.pose, msg.RosPose) else message.pose.pose
        spread = None if isinstance(message.pose, msg.RosPose) else message.pose.covariance
        place, turned = pose.position, pose.orientation
        norm = turned.x**2 + turned.y**2 + turned.z**2 + turned.w**2
        if not (math.isfinite(place.x + place.y + norm) and abs(norm - 1.0) < _UNIT_MARGIN):
            return "not finite, or without a heading", None
        stds = _stds(spread)
        if stds is None:
            return "with a covariance that cannot be", None
        yaw = math.atan2(
            2.0 * (turned.w * turned.z + turned.x * turned.y), 1.0 - 2.0 * (turned.y * turned.y + turned.z * turned.z)
        )
        self._newest_ns, self._passed_ns = t_ns, mono_ns
        return "", {
            "t_ns": t_ns,
            "x_m": place.x,
            "y_m": place.y,
            "yaw_rad": yaw,
            "position_std_m": stds[0] or wanted.position_std_m,
            "yaw_std_rad": stds[1] or wanted.yaw_std_rad,
        }


def _stds(covariance: Sequence[float] | None) -> tuple[float, float] | None:
    """Standard deviations of position (m) and yaw (rad), 0 where they are not given; None for what cannot be."""
    if covariance is None:
        return 0.0, 0.0
    xx, yy, tt = covariance[0], covariance[7], covariance[35]
    if not (math.isfinite(xx + yy + tt) and min(xx, yy, tt) >= 0.0):
        return None
    return math.sqrt(max(xx, yy)), math.sqrt(tt)
