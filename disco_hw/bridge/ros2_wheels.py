"""What the bridge hears of a base's wheels: a JointState or an Odometry as angles and speeds, or why it is none; pure.

An Odometry has been through the base's own kinematics: its way and turn are taken back to wheels by the nominal
geometry. Distances are those between poses, so that a lost message loses nothing.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from disco_hw.bridge import ros2_messages as msg
from drivers.motor.ros2_base_wire import REFUSALS, Ros2BaseSettings, Wheels

_AHEAD_NS, _OLDEST_NS = 50_000_000, 500_000_000
_SECOND_NS = 1_000_000_000
_NOTHING, _CLOCK, _JOINTS, _VALUES, _ORDER = range(len(REFUSALS))
_FASTER = 2.0
Both = tuple[float, float]


class WheelInlet:
    """Judges what is heard of the wheels, and counts what it refuses, by reason."""

    def __init__(self, settings: Ros2BaseSettings) -> None:
        self.refused: Counter[str] = Counter()
        self._settings = settings
        self._joints = {*settings.left_joints, *settings.right_joints}
        self._newest_ns = -_SECOND_NS
        self._before: Wheels | None = None
        self._pose: tuple[float, float, float] | None = None
        self._why, self._why_ns = _NOTHING, -_SECOND_NS

    def wheels(self, message: msg.JointState | msg.Odometry, sent_ns: int, mono_ns: int, wall_ns: int) -> Wheels | None:
        """The wheels by a message heard now; None for what is refused, or says nothing of them.

        `sent_ns`: when it was sent, by the sender's wall clock, which counts where the message has no stamp.
        """
        age_ns = wall_ns - (msg.time_of(message.header.stamp) or sent_ns)
        if isinstance(message, msg.JointState) and not self._joints & set(message.name):
            return None
        if not -_AHEAD_NS <= age_ns <= _OLDEST_NS:
            self._refuse(_CLOCK, mono_ns)
            return None
        true_ns = mono_ns - max(0, age_ns)
        if true_ns <= self._newest_ns:
            self._refuse(_ORDER, mono_ns)
            return None
        elapsed_s = (true_ns - self._newest_ns) * 1e-9
        found = self._of_joints(message, elapsed_s) if isinstance(message, msg.JointState) else self._of_pose(message)
        if found is None:
            self._refuse(_JOINTS, mono_ns)
            return None
        angles, speeds = found
        if not math.isfinite(sum(angles + speeds)) or max(map(abs, speeds)) > _FASTER * self._settings.fastest_rad_s:
            self._refuse(_VALUES, mono_ns)
            return None
        self._newest_ns = true_ns
        self._before = Wheels(angles, speeds, (mono_ns - true_ns) * 1e-9)
        if isinstance(message, msg.Odometry):
            self._pose = _planar(message)
        return self._before

    def why(self, now_ns: int) -> int:
        """Why nothing usable was heard, of REFUSALS."""
        return self._why if now_ns - self._why_ns < _SECOND_NS else _NOTHING

    def _refuse(self, why: int, mono_ns: int) -> None:
        self.refused[REFUSALS[why]] += 1
        self._why, self._why_ns = why, mono_ns

    def _of_joints(self, message: msg.JointState, elapsed_s: float) -> tuple[Both, Both] | None:
        """The mean of each side; speeds from the angles where there are none. None where a joint is missing."""
        at = {name: place for place, name in enumerate(message.name)}
        sides = (self._settings.left_joints, self._settings.right_joints)
        if not at.keys() >= self._joints or len(message.position) < len(message.name):
            return None
        angles = _means(sides, at, message.position)
        if len(message.velocity) == len(message.name):
            return angles, _means(sides, at, message.velocity)
        if self._before is None:
            return angles, (0.0, 0.0)
        before = self._before.angles_rad
        return angles, ((angles[0] - before[0]) / elapsed_s, (angles[1] - before[1]) / elapsed_s)

    def _of_pose(self, message: msg.Odometry) -> tuple[Both, Both]:
        """Where an ideal base with this geometry would have turned its wheels to."""
        pose = _planar(message)
        angles = (0.0, 0.0) if self._before is None else self._before.angles_rad
        if self._pose is not None:
            turn = math.remainder(pose[2] - self._pose[2], math.tau) if math.isfinite(pose[2]) else math.nan
            middle = self._pose[2] + 0.5 * turn
            way = (pose[0] - self._pose[0]) * math.cos(middle) + (pose[1] - self._pose[1]) * math.sin(middle)
            left, right = self._turned(way, turn)
            angles = (angles[0] + left, angles[1] + right)
        speed = message.twist.twist
        return angles, self._turned(speed.linear.x, speed.angular.z)

    def _turned(self, way: float, turn: float) -> Both:
        half, radius = 0.5 * self._settings.track_m * turn, self._settings.wheel_radius_m
        return (way - half) / radius, (way + half) / radius


def _means(sides: tuple[tuple[str, ...], tuple[str, ...]], at: dict[str, int], values: Sequence[float]) -> Both:
    left, right = (sum(values[at[name]] for name in side) / len(side) for side in sides)
    return left, right


def _planar(message: msg.Odometry) -> tuple[float, float, float]:
    place, turned = message.pose.pose.position, message.pose.pose.orientation
    yaw = math.atan2(
        2.0 * (turned.w * turned.z + turned.x * turned.y), 1.0 - 2.0 * (turned.y * turned.y + turned.z * turned.z)
    )
    return place.x, place.y, yaw
