"""Gaussian belief over the pose, its prediction by odometry, and its bounds."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from disco_hw.config import Estimation
from disco_hw.estimation.odometry import Arc, Matrix3, OdometryParameters, Pose, wrap

Flat9 = tuple[float, float, float, float, float, float, float, float, float]

# A yaw that is anywhere on the circle has this variance; a position is as good as unknown beyond 100 m.
MAX_YAW_VARIANCE = math.pi**2 / 3.0
MAX_POSITION_VARIANCE = 1e4


class PoseBelief(msgspec.Struct, frozen=True, gc=False):
    """Gaussian over (x, y, yaw) in m and rad.

    xx ... tt (t stands for yaw) are the six different entries of the covariance that would remain if the odometry's
    parameters were known. `sensitivity` W (3x3, row by row; None if they are known) is the error of the pose caused by
    one standard deviation of each independent combination of the parameters; the covariance is xx... + W W'.
    Plain floats: a rewind predicts a hundred times, and array operations on three numbers cost more than the step.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    xx: float
    xy: float
    xt: float
    yy: float
    yt: float
    tt: float
    sensitivity: Flat9 | None

    @property
    def pose(self) -> Pose:
        """The mean."""
        return Pose(self.x_m, self.y_m, self.yaw_rad)

    @property
    def covariance(self) -> Matrix3:
        """The whole covariance as nested tuples, symmetric to the bit."""
        xx, xy, xt, yy, yt, tt = self.xx, self.xy, self.xt, self.yy, self.yt, self.tt
        if self.sensitivity is not None:
            x0, x1, x2, y0, y1, y2, t0, t1, t2 = self.sensitivity
            xx += x0 * x0 + x1 * x1 + x2 * x2
            xy += x0 * y0 + x1 * y1 + x2 * y2
            xt += x0 * t0 + x1 * t1 + x2 * t2
            yy += y0 * y0 + y1 * y1 + y2 * y2
            yt += y0 * t0 + y1 * t1 + y2 * t2
            tt += t0 * t0 + t1 * t1 + t2 * t2
        return (xx, xy, xt), (xy, yy, yt), (xt, yt, tt)


class MotionModel(msgspec.Struct, frozen=True, gc=False):
    """What prediction needs to know: geometry, slip as variance per metre rolled or radian turned (so that it does not
    depend on the sampling rate), and a square root of the covariance of (wheel_radius_m, axial_distance_m, x_icr_m),
    3x3 row by row, or None if they are known.
    """

    parameters: OdometryParameters
    position_m2_per_m: float
    yaw_rad2_per_m: float
    yaw_rad2_per_rad: float
    parameter_root: Flat9 | None


def motion_model(settings: Estimation, parameters: OdometryParameters) -> MotionModel:
    """Derive the motion model from robot.toml and the odometry's parameters."""
    root: Flat9 | None = None
    if parameters.covariance is not None:
        eigenvalues, vectors = np.linalg.eigh(np.array(parameters.covariance))
        flat = (vectors * np.sqrt(np.clip(eigenvalues, 0.0, None))).ravel().tolist()
        a, b, c, d, e, f, g, h, i = flat
        root = (a, b, c, d, e, f, g, h, i)
    return MotionModel(
        parameters,
        settings.slip_std_m_per_sqrt_m**2,
        settings.slip_std_rad_per_sqrt_m**2,
        settings.slip_std_rad_per_sqrt_rad**2,
        root,
    )


def belief_at(pose: Pose, position_variance: float, yaw_variance: float, model: MotionModel) -> PoseBelief:
    """A belief with independent x, y (the same variance, m^2) and yaw (rad^2), independent of the parameters."""
    sensitivity: Flat9 | None = None if model.parameter_root is None else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    x, y, yaw = pose.x_m, pose.y_m, wrap(pose.yaw_rad)
    return PoseBelief(x, y, yaw, position_variance, 0.0, 0.0, position_variance, 0.0, yaw_variance, sensitivity)


def rebased(belief: PoseBelief, model: MotionModel) -> PoseBelief:
    """The same belief under other parameters, whose error has nothing to do with what those before have caused."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = belief.covariance
    sensitivity: Flat9 | None = None if model.parameter_root is None else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    return PoseBelief(belief.x_m, belief.y_m, belief.yaw_rad, xx, xy, xt, yy, yt, tt, sensitivity)


def predict(
    belief: PoseBelief,
    model: MotionModel,
    motion: Arc,
    extra_position_variance: float = 0.0,
    extra_yaw_variance: float = 0.0,
) -> PoseBelief:
    """Carry a belief through a motion: mean along the arc, P' = F P F' + Q, W' = F W + J.

    Q: slip displaces the tracked point by an isotropic error and turns the body about its centre of rotation by a yaw
    error. J = d pose / d (independent combinations of the parameters): their error is the same in every step and adds
    up with the distance instead of averaging out, which is the consider filter of Schmidt (1966). The extra variances
    (m^2, rad^2) are those of motion that was not measured.
    """
    cosine, sine = math.cos(belief.yaw_rad), math.sin(belief.yaw_rad)
    dx = cosine * motion.forward_m - sine * motion.left_m
    dy = sine * motion.forward_m + cosine * motion.left_m
    x_by_turn = cosine * motion.forward_by_turn - sine * motion.left_by_turn
    y_by_turn = sine * motion.forward_by_turn + cosine * motion.left_by_turn

    position_variance = model.position_m2_per_m * motion.rolled_m + extra_position_variance
    yaw_variance = (
        model.yaw_rad2_per_m * motion.rolled_m + model.yaw_rad2_per_rad * abs(motion.turn_rad) + extra_yaw_variance
    )
    xt = belief.xt - dy * belief.tt
    yt = belief.yt + dx * belief.tt
    xx = belief.xx - dy * (belief.xt + xt) + position_variance + x_by_turn * x_by_turn * yaw_variance
    yy = belief.yy + dx * (belief.yt + yt) + position_variance + y_by_turn * y_by_turn * yaw_variance
    xy = belief.xy + dx * belief.xt - dy * yt + x_by_turn * y_by_turn * yaw_variance
    xt += x_by_turn * yaw_variance
    yt += y_by_turn * yaw_variance
    tt = belief.tt + yaw_variance

    total_xx, total_yy, total_tt = xx, yy, tt
    sensitivity = belief.sensitivity
    if sensitivity is not None and model.parameter_root is not None:
        x0, x1, x2, y0, y1, y2, t0, t1, t2 = sensitivity
        r0, r1, r2, a0, a1, a2, i0, i1, i2 = model.parameter_root
        distance_by_radius = motion.distance_m / model.parameters.wheel_radius_m
        turn_by_radius = motion.turn_rad / model.parameters.wheel_radius_m
        turn_by_axial = -motion.turn_rad / model.parameters.axial_distance_m
        xr = (cosine * motion.forward_by_distance - sine * motion.left_by_distance) * distance_by_radius
        yr = (sine * motion.forward_by_distance + cosine * motion.left_by_distance) * distance_by_radius
        xi = cosine * motion.forward_by_x_icr - sine * motion.left_by_x_icr
        yi = sine * motion.forward_by_x_icr + cosine * motion.left_by_x_icr
        g0 = turn_by_radius * r0 + turn_by_axial * a0
        g1 = turn_by_radius * r1 + turn_by_axial * a1
        g2 = turn_by_radius * r2 + turn_by_axial * a2
        x0 += xr * r0 + x_by_turn * g0 + xi * i0 - dy * t0
        x1 += xr * r1 + x_by_turn * g1 + xi * i1 - dy * t1
        x2 += xr * r2 + x_by_turn * g2 + xi * i2 - dy * t2
        y0 += yr * r0 + y_by_turn * g0 + yi * i0 + dx * t0
        y1 += yr * r1 + y_by_turn * g1 + yi * i1 + dx * t1
        y2 += yr * r2 + y_by_turn * g2 + yi * i2 + dx * t2
        t0, t1, t2 = t0 + g0, t1 + g1, t2 + g2
        sensitivity = (x0, x1, x2, y0, y1, y2, t0, t1, t2)
        total_xx += x0 * x0 + x1 * x1 + x2 * x2
        total_yy += y0 * y0 + y1 * y1 + y2 * y2
        total_tt += t0 * t0 + t1 * t1 + t2 * t2

    yaw = wrap(belief.yaw_rad + motion.turn_rad)
    predicted = PoseBelief(belief.x_m + dx, belief.y_m + dy, yaw, xx, xy, xt, yy, yt, tt, sensitivity)
    if total_xx > MAX_POSITION_VARIANCE or total_yy > MAX_POSITION_VARIANCE or total_tt > MAX_YAW_VARIANCE:
        return _scaled(
            predicted,
            math.sqrt(min(1.0, MAX_POSITION_VARIANCE / total_xx)),
            math.sqrt(min(1.0, MAX_POSITION_VARIANCE / total_yy)),
            math.sqrt(min(1.0, MAX_YAW_VARIANCE / total_tt)),
        )
    return predicted


def _scaled(belief: PoseBelief, x: float, y: float, t: float) -> PoseBelief:
    """Scale the error of each coordinate; D P D with D diagonal stays positive definite."""
    sensitivity = belief.sensitivity
    if sensitivity is not None:
        x0, x1, x2, y0, y1, y2, t0, t1, t2 = sensitivity
        sensitivity = (x * x0, x * x1, x * x2, y * y0, y * y1, y * y2, t * t0, t * t1, t * t2)
    return PoseBelief(
        belief.x_m,
        belief.y_m,
        belief.yaw_rad,
        x * x * belief.xx,
        x * y * belief.xy,
        x * t * belief.xt,
        y * y * belief.yy,
        y * t * belief.yt,
        t * t * belief.tt,
        sensitivity,
    )
