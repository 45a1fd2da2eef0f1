"""What a measured pose must pass: screening of the sample itself, and the limit of the Mahalanobis gate."""

from __future__ import annotations

import enum
import math

import msgspec

from disco_hw.estimation.belief import MAX_POSITION_VARIANCE, MAX_YAW_VARIANCE
from disco_hw.estimation.odometry import Pose
from drivers.types import PoseSample

MAX_POSITION_M = 1000.0
MAX_YAW_RAD = 1e4
MIN_POSITION_STD_M = 1e-3
MIN_YAW_STD_RAD = 1e-3


class PoseReason(enum.Enum):
    """What became of a measured pose."""

    ACCEPTED = "accepted"
    INITIALISED = "initialised"
    REINITIALISED = "reinitialised"
    GATED = "gated"
    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    FUTURE = "future"
    TOO_OLD = "too_old"
    DUPLICATE = "duplicate"
    NO_ODOMETRY = "no_odometry"
    OVERFLOW = "overflow"

    @property
    def accepted(self) -> bool:
        """Whether the pose took part in the estimate."""
        return self in (PoseReason.ACCEPTED, PoseReason.INITIALISED, PoseReason.REINITIALISED)


class Measurement(msgspec.Struct, frozen=True, gc=False):
    """A screened pose with the variances that it is fused with (m^2, rad^2)."""

    t_ns: int
    pose: Pose
    position_variance: float
    yaw_variance: float
    floored: bool


def screen(sample: PoseSample) -> Measurement | PoseReason:
    """Refuse a sample that is no pose; give one without usable standard deviations the nearest usable ones.

    Not finite: any field. Out of range: |x| or |y| above 1 km, |yaw| above 1e4 rad. Standard deviations are held
    between 1 mm and 100 m, 1 mrad and 1.8 rad; `floored` says that one was raised.
    """
    values = (sample.x_m, sample.y_m, sample.yaw_rad, sample.position_std_m, sample.yaw_std_rad)
    if not all(map(math.isfinite, values)):
        return PoseReason.NOT_FINITE
    if abs(sample.x_m) > MAX_POSITION_M or abs(sample.y_m) > MAX_POSITION_M or abs(sample.yaw_rad) > MAX_YAW_RAD:
        return PoseReason.OUT_OF_RANGE
    position_std_m = min(max(sample.position_std_m, MIN_POSITION_STD_M), math.sqrt(MAX_POSITION_VARIANCE))
    yaw_std_rad = min(max(sample.yaw_std_rad, MIN_YAW_STD_RAD), math.sqrt(MAX_YAW_VARIANCE))
    return Measurement(
        t_ns=sample.t_ns,
        pose=Pose(sample.x_m, sample.y_m, sample.yaw_rad),
        position_variance=position_std_m**2,
        yaw_variance=yaw_std_rad**2,
        floored=position_std_m > sample.position_std_m or yaw_std_rad > sample.yaw_std_rad,
    )


def gate_limit(probability: float) -> float:
    """Squared Mahalanobis distance that a right pose stays below with this probability (chi-square, 3 degrees).

    Raises ValueError for a probability that is not between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"a probability between 0 and 1, not {probability}")
    low, high = 0.0, 1500.0
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _exceeded(middle) > 1.0 - probability else (low, middle)
    return middle


def _exceeded(distance2: float) -> float:
    """Probability that chi-square with 3 degrees of freedom exceeds this (Abramowitz and Stegun, 26.4.4)."""
    half = 0.5 * distance2
    return math.erfc(math.sqrt(half)) + 2.0 * math.sqrt(half / math.pi) * math.exp(-half)
