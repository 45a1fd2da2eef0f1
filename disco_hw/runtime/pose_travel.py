"""Wheel speeds by the measured poses alone: straight lines through the newest of them, with what noise leaves open."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from disco_hw.estimation.odometry import OdometryParameters
from drivers.types import PoseSample

# Chosen: longer averages more noise out, and shows a change of speed later.
KEPT_NS = 1_000_000_000
# Two lie on a line always; two more show whether it is one.
LEAST_POSES = 4
LARGEST_OFF, CURVED_PART = 5.0, 0.2
"""A pose lies so many standard deviations from the line at most, and the part of the way by which a robot that speeds
up from rest leaves it; a jump is more.
"""


class PosedSpeeds(NamedTuple):
    """Left and right wheel speed (rad/s) and the standard deviation of both, by the noise of the poses alone."""

    left_rad_s: float
    right_rad_s: float
    std_rad_s: float


class PoseTravel:
    """The newest poses with a heading of the first source; pure."""

    def __init__(self) -> None:
        self._poses: deque[PoseSample] = deque()

    @property
    def newest_ns(self) -> int | None:
        """Time at which the newest pose was true; None before the first."""
        return self._poses[-1].t_ns if self._poses else None

    def add(self, pose: PoseSample) -> bool:
        """Take in a pose; returns whether it is used."""
        newest_ns = self.newest_ns
        is_out_of_order = newest_ns is not None and pose.t_ns <= newest_ns
        finite = math.isfinite(pose.x_m) and math.isfinite(pose.y_m) and math.isfinite(pose.yaw_rad)
        if pose.source != 0 or not pose.has_heading or not finite or is_out_of_order:
            return False
        self._poses.append(pose)
        while pose.t_ns - self._poses[0].t_ns > KEPT_NS:
            self._poses.popleft()
        return True

    def wheel_speeds(self, since_ns: int, geometry: OdometryParameters) -> PosedSpeeds | None:
        """Return how the wheels turned since then; None from too few poses, or if they jump."""
        used = [pose for pose in self._poses if pose.t_ns >= since_ns]
        if len(used) < LEAST_POSES:
            return None
        first = used[0]
        times = [(pose.t_ns - first.t_ns) * 1e-9 for pose in used]
        mean_s = sum(times) / len(times)
        weights = [time - mean_s for time in times]
        yaws = [math.remainder(pose.yaw_rad - first.yaw_rad, 2.0 * math.pi) for pose in used]
        along = first.yaw_rad + sum(yaws) / len(yaws)
        cosine, sine = math.cos(along), math.sin(along)
        moved = [(pose.x_m - first.x_m, pose.y_m - first.y_m) for pose in used]
        position_std_m = max(pose.position_std_m for pose in used)
        yaw_std_rad = max(pose.yaw_std_rad for pose in used)
        ahead = _line(weights, [x * cosine + y * sine for x, y in moved], position_std_m)
        aside = _line(weights, [y * cosine - x * sine for x, y in moved], position_std_m)
        turn = _line(weights, yaws, yaw_std_rad)
        if ahead is None or aside is None or turn is None:
            return None
        half_m, radius_m = 0.5 * geometry.axial_distance_m, geometry.wheel_radius_m
        left, right = ((ahead[0] + side * half_m * turn[0]) / radius_m for side in (-1.0, 1.0))
        return PosedSpeeds(left, right, math.hypot(ahead[1], half_m * turn[1]) / radius_m)


def _line(weights: Sequence[float], values: Sequence[float], std: float) -> tuple[float, float] | None:
    """Slope of the least-squares line and its standard deviation, from times less their mean; None with an outlier."""
    mean = sum(values) / len(values)
    spread = sum(weight * weight for weight in weights)
    slope = sum(weight * value for weight, value in zip(weights, values, strict=True)) / spread
    off = [value - mean - slope * weight for weight, value in zip(weights, values, strict=True)]
    if max(map(abs, off)) > LARGEST_OFF * std + CURVED_PART * (max(values) - min(values)):
        return None
    scatter = math.sqrt(sum(each * each for each in off) / (len(off) - 2))
    return slope, max(std, scatter) / math.sqrt(spread)
