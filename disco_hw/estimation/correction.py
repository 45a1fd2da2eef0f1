"""Correction of a belief by a measured pose: screening, the Mahalanobis gate, and filterpy's extended Kalman filter."""

from __future__ import annotations

import enum
import importlib
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.estimation.odometry import (
    MAX_POSITION_VARIANCE,
    MAX_YAW_VARIANCE,
    Flat9,
    Pose,
    PoseBelief,
    wrap,
)
from drivers.types import PoseSample


@contextmanager
def deferred(*names: str) -> Iterator[None]:
    """Put off the import of these modules by what the block imports, until something of them is called.

    What the block takes from them by `from NAME import THING` is a stand-in for that function. Whoever imports the
    modules afterwards gets them as ever. Nothing happens to one that is imported already.
    """
    deferred_modules = {name: _DeferredModule(name) for name in names if name not in sys.modules}
    sys.modules.update(deferred_modules)
    try:
        yield
    finally:
        for name in deferred_modules:
            del sys.modules[name]


class _DeferredModule(ModuleType):
    """A module as it is seen by an import statement: it has every function, whose call imports the module."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments: Any, **named: Any) -> Any:
            return getattr(importlib.import_module(self.__name__), name)(*arguments, **named)

        return call


# Above FARTHEST_M, which a place may lie away; a pose beyond these numbers is an error of the sensor.
MAX_POSITION_M = 1000.0
MAX_YAW_RAD = 1e4
# Chosen: less than any sensor achieves; a pose that claims to be exact would leave no room for odometry.
MIN_POSITION_STD_M = 1e-3
MIN_YAW_STD_RAD = 1e-3


class PoseReason(enum.Enum):
    """Reasons why the filter accepted or refused a measured pose."""

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
    """A screened pose with the variances that it is fused with (m^2, rad^2).

    `yaw_variance` is None where no heading was measured; `pose.yaw_rad` is then 0. The position is that of the point
    `lever_x_m` ahead and `lever_y_m` to the left of the tracked one. `forgets_heading`: that of the belief before is no
    measurement.
    """

    t_ns: int
    pose: Pose
    position_variance: float
    yaw_variance: float | None
    floored: bool
    lever_x_m: float = 0.0
    lever_y_m: float = 0.0
    source: int = 0
    forgets_heading: bool = False

    def lever(self, yaw_rad: float) -> tuple[float, float, float, float]:
        """Return the lever arm in the world (x, y) of a robot with this heading, and its derivative by the heading."""
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        x = cosine * self.lever_x_m - sine * self.lever_y_m
        y = sine * self.lever_x_m + cosine * self.lever_y_m
        return x, y, -y, x


def screen(sample: PoseSample) -> Measurement | PoseReason:
    """Refuse a sample that is no pose; give one without usable standard deviations the nearest usable ones.

    Not finite: any field, but for both of a heading that was not measured. Out of range: |x| or |y| above 1 km, |yaw|
    above 1e4 rad. Standard deviations are held between 1 mm and 100 m, 1 mrad and 1.8 rad; `floored` says that one was
    raised.
    """
    position = (sample.x_m, sample.y_m, sample.position_std_m, sample.lever_x_m, sample.lever_y_m)
    has_heading = sample.has_heading
    if not all(map(math.isfinite, position)):
        return PoseReason.NOT_FINITE
    if has_heading and not (math.isfinite(sample.yaw_rad) and math.isfinite(sample.yaw_std_rad)):
        return PoseReason.NOT_FINITE
    if max(abs(sample.x_m), abs(sample.y_m), abs(sample.lever_x_m), abs(sample.lever_y_m)) > MAX_POSITION_M:
        return PoseReason.OUT_OF_RANGE
    if has_heading and abs(sample.yaw_rad) > MAX_YAW_RAD:
        return PoseReason.OUT_OF_RANGE
    position_std_m = min(max(sample.position_std_m, MIN_POSITION_STD_M), math.sqrt(MAX_POSITION_VARIANCE))
    yaw_std_rad = min(max(sample.yaw_std_rad, MIN_YAW_STD_RAD), math.sqrt(MAX_YAW_VARIANCE))
    return Measurement(
        t_ns=sample.t_ns,
        pose=Pose(sample.x_m, sample.y_m, sample.yaw_rad if has_heading else 0.0),
        position_variance=position_std_m**2,
        yaw_variance=yaw_std_rad**2 if has_heading else None,
        floored=position_std_m > sample.position_std_m or (has_heading and yaw_std_rad > sample.yaw_std_rad),
        lever_x_m=sample.lever_x_m,
        lever_y_m=sample.lever_y_m,
        source=sample.source,
    )


def gate_limit(probability: float, with_heading: bool = True) -> float:
    """Squared Mahalanobis distance that a right pose stays below with this probability.

    Chi-square with three degrees of freedom, with two for a position alone.
    """
    if not with_heading:
        return -2.0 * math.log(1.0 - probability)
    low, high = 0.0, 1500.0
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _exceeded(middle) > 1.0 - probability else (low, middle)
    return middle


def _exceeded(distance2: float) -> float:
    """Probability that chi-square with 3 degrees of freedom exceeds this (Abramowitz and Stegun, 26.4.4)."""
    half = 0.5 * distance2
    return math.erfc(math.sqrt(half)) + 2.0 * math.sqrt(half / math.pi) * math.exp(-half)


# What is not used here of filterpy brings most of scipy with it, into a process that locks its memory.
with deferred("filterpy.stats", "scipy.ndimage"):
    from filterpy.kalman import ExtendedKalmanFilter

Vector = NDArray[np.float64]
Triple = tuple[float, float, float]

# Added to the covariance at each correction: a thousand poses at standstill do not average away the sensor's bias, and
# the covariance stays positive definite whatever is rounded. (0.05 mm)^2 and (0.05 mrad)^2.
FLOOR_VARIANCE = 2.5e-9
_IDENTITY = np.eye(3)
_IDENTITY.flags.writeable = False


class Correction(msgspec.Struct, frozen=True, gc=False):
    """The corrected belief, and how the measurement fitted the prior one.

    `innovation` is measured minus predicted (m, m, rad; yaw wrapped), `innovation_variance` the diagonal of its
    covariance S, both with NaN in place of a heading that was not measured; `distance2` the squared Mahalanobis
    distance innovation' S^-1 innovation, `log_density` that of the measurement but for a constant.
    """

    belief: PoseBelief
    innovation: Triple
    innovation_variance: Triple
    distance2: float
    log_density: float


class PoseCorrector:
    """Applies measured poses to beliefs; holds filterpy's filters as work space, and nothing from call to call.

    filterpy does the gain, the Joseph form and the Mahalanobis distance. Its prediction is linear and it knows neither
    gates nor time, so that those are ours; its arrays broadcast silently when a shape is wrong, so that all are made
    (3,) and (3, 3) and checked.
    """

    def __init__(self) -> None:
        self._of_poses = ExtendedKalmanFilter(dim_x=3, dim_z=3)
        self._of_positions = ExtendedKalmanFilter(dim_x=3, dim_z=2)

    def correct(self, belief: PoseBelief, measurement: Measurement) -> Correction:
        """Fuse one pose into a belief; the caller decides by `distance2` whether to take the result."""
        pose, position, yaw = measurement.pose, measurement.position_variance, measurement.yaw_variance
        ahead_x, ahead_y, by_yaw_x, by_yaw_y = measurement.lever(belief.yaw_rad)
        jacobian, predicted = _IDENTITY, np.array((belief.x_m + ahead_x, belief.y_m + ahead_y, belief.yaw_rad))
        if by_yaw_x or by_yaw_y:
            jacobian = np.array(((1.0, 0.0, by_yaw_x), (0.0, 1.0, by_yaw_y), (0.0, 0.0, 1.0)))
        ekf = self._of_positions if yaw is None else self._of_poses
        ekf.x = np.array((belief.x_m, belief.y_m, belief.yaw_rad))
        ekf.P = np.array(belief.covariance)
        if yaw is None:
            ekf.R = np.array(((position, 0.0), (0.0, position)))
            measured = np.array((pose.x_m, pose.y_m))
            ekf.update(measured, lambda _state: jacobian[:2], lambda _state: predicted[:2])
        else:
            ekf.R = np.array(((position, 0.0, 0.0), (0.0, position, 0.0), (0.0, 0.0, yaw)))
            measured = np.array((pose.x_m, pose.y_m, pose.yaw_rad))
            ekf.update(measured, lambda _state: jacobian, lambda _state: predicted, residual=_residual)
        if ekf.x.shape != (3,) or ekf.P.shape != (3, 3) or ekf.S.shape != measured.shape * 2:
            raise AssertionError(f"filterpy returned shapes {ekf.x.shape}, {ekf.P.shape}, {ekf.S.shape}")
        distance2 = float(ekf.mahalanobis) ** 2
        x, y, yaw_rad = ekf.x.tolist()
        covariance, sensitivity = ekf.P, None
        if belief.sensitivity is not None:
            # The parameters are not estimated: their part of the error shrinks like any other error of the pose.
            part = (_IDENTITY - ekf.K @ jacobian[: measured.size]) @ np.array(belief.sensitivity).reshape(3, 3)
            covariance = covariance - part @ part.T
            sensitivity = _flat(part)
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
        innovation, variance = ekf.y.tolist(), ekf.S.diagonal().tolist()
        return Correction(
            PoseBelief(
                x,
                y,
                wrap(yaw_rad),
                xx + FLOOR_VARIANCE,
                xy,
                xt,
                yy + FLOOR_VARIANCE,
                yt,
                tt + FLOOR_VARIANCE,
                sensitivity,
            ),
            (innovation[0], innovation[1], math.nan if yaw is None else innovation[2]),
            (variance[0], variance[1], math.nan if yaw is None else variance[2]),
            distance2,
            -0.5 * (distance2 + math.log(float(np.linalg.det(ekf.S)))),
        )


def _flat(matrix: Vector) -> Flat9:
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return a, b, c, d, e, f, g, h, i


def _residual(measured: Vector, predicted: Vector) -> Vector:
    difference: Vector = measured - predicted
    difference[2] = wrap(float(difference[2]))
    return difference


class PoseUpdate(msgspec.Struct, frozen=True, gc=False):
    """Result of one measured pose in the filter.

    `innovation` is measured minus predicted (x m, y m, yaw rad), `innovation_variance` the diagonal of its covariance
    S, `distance2` its squared Mahalanobis distance, `test_ratio` that over the gate's limit (above 1: outside). They
    are None where there was nothing to compare with. `age_s` is how long ago the pose was true.
    """

    t_ns: int
    age_s: float
    reason: PoseReason
    innovation: Triple | None = None
    innovation_variance: Triple | None = None
    distance2: float | None = None
    test_ratio: float | None = None

    @property
    def accepted(self) -> bool:
        """Whether the pose took part in the estimate."""
        return self.reason.accepted
