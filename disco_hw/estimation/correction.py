"""Correction of a belief by a measured pose: screening, the Mahalanobis gate, and filterpy's extended Kalman filter."""

from __future__ import annotations

import enum
import importlib
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.estimation.belief import MAX_POSITION_VARIANCE, MAX_YAW_VARIANCE, Flat9, PoseBelief
from disco_hw.estimation.odometry import Pose, wrap
from drivers.types import PoseSample


@contextmanager
def deferred(*names: str) -> Iterator[None]:
    """Put off the import of these modules by what the block imports, until something of them is called.

    What the block takes from them by `from NAME import THING` is a stand-in for that function or object. Whoever
    imports the modules afterwards gets them as ever. Nothing happens to one that is imported already.
    """
    put_off = {name: _DeferredModule(name) for name in names if name not in sys.modules}
    sys.modules.update(put_off)
    try:
        yield
    finally:
        for name in put_off:
            del sys.modules[name]


class _DeferredModule(ModuleType):
    """A module as it is seen by an import statement: everything is in it."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _DeferredThing(self.__name__, name)


class _DeferredThing:
    """Something of a module; using it imports the module."""

    def __init__(self, module: str, name: str) -> None:
        self._source = module, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._thing(), name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._thing()(*arguments, **named)

    def _thing(self) -> Any:
        module, name = self._source
        return getattr(importlib.import_module(module), name)


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


# What is not used here of filterpy brings most of scipy with it, into a process that locks its memory.
with deferred("filterpy.stats", "scipy.ndimage"):
    from filterpy.kalman import ExtendedKalmanFilter

Vector = NDArray[np.float64]
Triple = tuple[float, float, float]

# Added to the covariance at each correction: a thousand poses at standstill do not average away the sensor's bias, and
# the covariance stays positive definite whatever is rounded. (0.05 mm)^2 and (0.05 mrad)^2.
FLOOR_VARIANCE = 2.5e-9
# The pose is what is measured.
_IDENTITY = np.eye(3)
_IDENTITY.flags.writeable = False


class Correction(msgspec.Struct, frozen=True, gc=False):
    """The corrected belief, and how the measurement fitted the prior one.

    `innovation` is measured minus predicted (m, m, rad; yaw wrapped), `innovation_variance` the diagonal of its
    covariance S, `distance2` the squared Mahalanobis distance innovation' S^-1 innovation.
    """

    belief: PoseBelief
    innovation: Triple
    innovation_variance: Triple
    distance2: float


class PoseCorrector:
    """Applies measured poses to beliefs; holds filterpy's filter as work space, and nothing from call to call.

    filterpy does the gain, the Joseph form and the Mahalanobis distance. Its prediction is linear and it knows neither
    gates nor time, so that those are ours; its arrays broadcast silently when a shape is wrong, so that all are made
    (3,) and (3, 3) and checked.
    """

    def __init__(self) -> None:
        self._filter = ExtendedKalmanFilter(dim_x=3, dim_z=3)

    def correct(self, belief: PoseBelief, measurement: Measurement) -> Correction:
        """Fuse one pose; the caller decides by `distance2` whether to take the result."""
        pose = measurement.pose
        ekf = self._filter
        ekf.x = np.array((belief.x_m, belief.y_m, belief.yaw_rad))
        ekf.P = np.array(belief.covariance)
        position, yaw = measurement.position_variance, measurement.yaw_variance
        ekf.R = np.array(((position, 0.0, 0.0), (0.0, position, 0.0), (0.0, 0.0, yaw)))
        ekf.update(np.array((pose.x_m, pose.y_m, pose.yaw_rad)), _jacobian, _predicted, residual=_residual)
        if ekf.x.shape != (3,) or ekf.P.shape != (3, 3) or ekf.S.shape != (3, 3):
            raise AssertionError(f"filterpy returned shapes {ekf.x.shape}, {ekf.P.shape}, {ekf.S.shape}")
        x, y, yaw = ekf.x.tolist()
        covariance, sensitivity = ekf.P, None
        if belief.sensitivity is not None:
            # The parameters are not estimated: their part of the error shrinks like any other error of the pose.
            part = (_IDENTITY - ekf.K) @ np.array(belief.sensitivity).reshape(3, 3)
            covariance = covariance - part @ part.T
            sensitivity = _flat(part)
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = covariance.tolist()
        innovation_x, innovation_y, innovation_yaw = ekf.y.tolist()
        variance_x, variance_y, variance_yaw = ekf.S.diagonal().tolist()
        return Correction(
            PoseBelief(
                x,
                y,
                wrap(yaw),
                xx + FLOOR_VARIANCE,
                xy,
                xt,
                yy + FLOOR_VARIANCE,
                yt,
                tt + FLOOR_VARIANCE,
                sensitivity,
            ),
            (innovation_x, innovation_y, innovation_yaw),
            (variance_x, variance_y, variance_yaw),
            float(ekf.mahalanobis) ** 2,
        )


def _flat(matrix: Vector) -> Flat9:
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    return a, b, c, d, e, f, g, h, i


def _jacobian(_state: Vector) -> Vector:
    return _IDENTITY


def _predicted(state: Vector) -> Vector:
    return state


def _residual(measured: Vector, predicted: Vector) -> Vector:
    difference: Vector = measured - predicted
    difference[2] = wrap(float(difference[2]))
    return difference
