"""Estimates the motion that the geometry does not explain, from what measured poses correct in the fused one.

The fused pose follows wheels, geometry and the present estimate; what poses go on correcting is what that estimate
still lacks. Each part integrates the corrections in the frame in which it is constant: the integral of a body that
turns lags behind a slope, and one of the world behind unequal wheels; both together lag behind neither (the internal
model principle, Francis and Wonham 1976). As the corrections are those of the Kalman filter, poor poses move them less.
"""

from __future__ import annotations

import math

from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.fusion import PoseUpdate
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.model.disturbance import NO_DISTURBANCE, Disturbance
from drivers.types import PoseSample

BODY_PER_S, TURN_PER_S, WORLD_PER_S = 0.2, 0.25, 0.4
"""How fast the parts follow: of the body's way, of its turning, of the ground."""
STABLE_PART = 0.25
"""Neither follows faster than this part of the rate at which poses correct the pose itself."""
SLOW_M_S = 0.05
"""Below this speed a correction says little of what goes with the way."""
FORWARD, LEFT, CURVATURE_PER_M, DRIFT_M_S = 0.15, 0.3, 0.5, 0.1
"""Bounds of the parts, by size."""


class DisturbanceEstimator:
    """Finds a `Disturbance` beside a fusion that takes it into account. Pure: no clock."""

    def __init__(self) -> None:
        self.value = NO_DISTURBANCE
        self._before_ns: dict[int, int] = {}

    def take(
        self, sample: PoseSample, update: PoseUpdate, parameters: OdometryParameters, wheels_rad_s: tuple[float, float]
    ) -> None:
        """Take in what a pose did to the estimate of a robot with this geometry, its wheels turning so fast."""
        if update.reason is PoseReason.REINITIALISED:
            # The robot was carried: to other ground.
            self.value, self._before_ns = NO_DISTURBANCE, {}
            return
        if update.reason is not PoseReason.ACCEPTED or update.innovation is None or update.innovation_variance is None:
            return
        before_ns, self._before_ns[sample.source] = self._before_ns.get(sample.source), sample.t_ns
        carried = self.value.moving(*wheels_rad_s)
        if before_ns is None or sample.t_ns <= before_ns or carried == 0.0 or not sample.has_heading:
            return
        (x, y, turn), (x_variance, y_variance, turn_variance) = update.innovation, update.innovation_variance
        position, heading = sample.position_std_m**2, sample.yaw_std_rad**2
        place_gain = max(1.0 - 2.0 * position / (x_variance + y_variance), 0.0)
        turn_gain = max(1.0 - heading / turn_variance, 0.0)
        fastest = STABLE_PART * min(place_gain, turn_gain) / ((sample.t_ns - before_ns) * 1e-9)
        world = min(WORLD_PER_S, fastest) * carried * place_gain
        speed = 0.5 * parameters.wheel_radius_m * sum(wheels_rad_s)
        by_way = speed / (speed * speed + SLOW_M_S * SLOW_M_S)
        body, turning = min(BODY_PER_S, fastest) * by_way * place_gain, min(TURN_PER_S, fastest) * by_way * turn_gain
        cosine, sine = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
        old = self.value
        self.value = Disturbance(
            _within(old.forward + body * (cosine * x + sine * y), FORWARD),
            _within(old.left + body * (cosine * y - sine * x), LEFT),
            _within(old.curvature_per_m + turning * turn, CURVATURE_PER_M),
            _within(old.drift_x_m_s + world * x, DRIFT_M_S),
            _within(old.drift_y_m_s + world * y, DRIFT_M_S),
        )

    def change_geometry(
        self, before: OdometryParameters, after: OdometryParameters, wheels_rad_s: tuple[float, float]
    ) -> None:
        """Take off what another geometry explains of it at these wheel speeds, and no more than there was."""
        left, right = wheels_rad_s
        if left + right < 2.0 * SLOW_M_S / after.wheel_radius_m:
            return
        # Way to the left and turn for each metre forward.
        turns = [2.0 * (right - left) / ((left + right) * one.axial_distance_m) for one in (before, after)]
        slides = [-one.x_icr_m * turn for one, turn in zip((before, after), turns, strict=True)]
        old = self.value
        self.value = Disturbance(
            _less(old.forward, after.wheel_radius_m / before.wheel_radius_m - 1.0),
            _less(old.left, slides[1] - slides[0]),
            _less(old.curvature_per_m, turns[1] - turns[0]),
            old.drift_x_m_s,
            old.drift_y_m_s,
        )


def _within(value: float, bound: float) -> float:
    return min(max(value, -bound), bound)


def _less(value: float, explained: float) -> float:
    """What is left of a value; not more than it, and not beyond zero."""
    return value - min(max(explained, min(value, 0.0)), max(value, 0.0))
