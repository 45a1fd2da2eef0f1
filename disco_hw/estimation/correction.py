"""Correction of a belief by a measured pose, computed by filterpy's extended Kalman filter."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.estimation.belief import Belief, Flat9
from disco_hw.estimation.deferred import deferred
from disco_hw.estimation.gate import Measurement
from disco_hw.estimation.odometry import wrap

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

    belief: Belief
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

    def correct(self, belief: Belief, measurement: Measurement) -> Correction:
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
            Belief(
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
