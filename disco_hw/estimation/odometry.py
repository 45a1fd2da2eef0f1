"""Wheel odometry with continuous readings from samples, the exact arc that they make, and the belief along it.

The belief over the pose is a Gaussian; here are its prediction by odometry, and its bounds.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from disco_hw.config import Estimation
from drivers.types import WheelSample

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class Pose(msgspec.Struct, frozen=True, gc=False):
    """Pose of the tracked body point in the world frame: x, y in m, yaw in rad, counter-clockwise, in (-pi, pi]."""

    x_m: float
    y_m: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class OdometryParameters:
    """Geometry of the skid-steer model, and how well it is known.

    The point `x_icr_m` ahead of the tracked point moves as a unicycle (Kozlowski and Pazderski 2004: the tracked point
    slides sideways by v_y = -omega x_icr). `covariance` is that of (wheel_radius_m, axial_distance_m, x_icr_m), 3x3 in
    SI units, the error being constant over the run; None means exactly known.
    """

    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    covariance: Matrix3 | None = None


class Arc(msgspec.Struct, frozen=True, gc=False):
    """Motion over one interval, in the body frame of its start, with its derivatives.

    `distance_m` is the path of the unicycle point, `turn_rad` the change of yaw, `rolled_m` the mean path of the wheels
    over the ground; `forward_m`, `left_m` are the displacement of the tracked point, `..._by_...` its derivatives.
    """

    distance_m: float
    turn_rad: float
    rolled_m: float
    forward_m: float
    left_m: float
    forward_by_distance: float
    left_by_distance: float
    forward_by_turn: float
    left_by_turn: float
    forward_by_x_icr: float
    left_by_x_icr: float


# Below this half turn (rad) the series of sin(h)/h to h^2 is exact in doubles, while the quotients lose digits.
_SMALL_HALF_TURN_RAD = 1e-4


def arc(parameters: OdometryParameters, left_rad: float, right_rad: float) -> Arc:
    """Motion of the tracked point while the wheels turn by these angles (rad) at a constant ratio.

    Constant wheel speeds move the unicycle point on a circle, which is integrated in closed form (chord of length
    distance sin(h)/h in the direction of the half turn h); the tracked point follows rigidly, `x_icr_m` behind.
    """
    radius, x_icr = parameters.wheel_radius_m, parameters.x_icr_m
    distance = 0.5 * radius * (left_rad + right_rad)
    turn = radius * (right_rad - left_rad) / parameters.axial_distance_m
    half = 0.5 * turn
    if abs(half) < _SMALL_HALF_TURN_RAD:
        chord = 1.0 - half * half / 6.0
        along, across = chord * math.cos(half), chord * math.sin(half)
        along_by_turn, across_by_turn = -turn / 3.0, 0.5 - 0.125 * turn * turn
    else:
        sine = math.sin(half)
        chord = sine / half
        along, across = chord * math.cos(half), chord * sine
        along_by_turn = (math.cos(turn) - along) / turn
        across_by_turn = along - across / turn
    # sin(turn) = turn * along and 1 - cos(turn) = turn * across, without cancellation.
    sine_turn, versine_turn = turn * along, turn * across
    return Arc(
        distance,
        turn,
        0.5 * radius * (abs(left_rad) + abs(right_rad)),
        distance * along + x_icr * versine_turn,
        distance * across - x_icr * sine_turn,
        along,
        across,
        distance * along_by_turn + x_icr * sine_turn,
        distance * across_by_turn - x_icr * (1.0 - versine_turn),
        versine_turn,
        -sine_turn,
    )


def advance(parameters: OdometryParameters, pose: Pose, segments: Iterable[tuple[float, float, float]]) -> Pose:
    """Predict a pose forward through intervals of constant wheel speeds, without uncertainty.

    Each segment is (left speed rad/s, right speed rad/s, duration s); used to bring the state past known delays.
    """
    for left_speed, right_speed, duration_s in segments:
        pose = moved(pose, arc(parameters, left_speed * duration_s, right_speed * duration_s))
    return pose


def moved(pose: Pose, motion: Arc) -> Pose:
    """Apply a motion given in the pose's own frame."""
    cosine, sine = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
    return Pose(
        pose.x_m + cosine * motion.forward_m - sine * motion.left_m,
        pose.y_m + sine * motion.forward_m + cosine * motion.left_m,
        wrap(pose.yaw_rad + motion.turn_rad),
    )


def wrap(angle_rad: float) -> float:
    """Wrap a finite angle to (-pi, pi]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


# A stamp may be ahead of its reception by the error of the clock offset; more is a wrong stamp.
FUTURE_TOLERANCE_NS = 50_000_000
# Readings further apart than this leave the shape of the path between them open.
MAX_SAMPLE_GAP_NS = 100_000_000
# No wheel turns faster; twice what the wire can carry. The margin allows for jitter of the stamps.
MAX_WHEEL_SPEED_RAD_S = 131.0
JUMP_MARGIN_RAD = 1.0
# A double still resolves a micro-radian here.
MAX_WHEEL_ANGLE_RAD = 1e9


class WheelReading(msgspec.Struct, frozen=True, gc=False):
    """Continuous wheel angles (rad) and speeds (rad/s) at one instant.

    `after_gap`: samples are missing before it. `restarted`: its counter was found to have started anew.
    """

    t_ns: int
    left_rad: float
    right_rad: float
    left_speed_rad_s: float
    right_speed_rad_s: float
    after_gap: bool = False
    restarted: bool = False


class WheelReason(enum.Enum):
    """Reasons why a wheel sample was refused."""

    NOT_FINITE = "not_finite"
    OUT_OF_RANGE = "out_of_range"
    FUTURE = "future"
    OUT_OF_ORDER = "out_of_order"


class WheelTracker:
    """Turns samples into readings whose time only grows and whose angles go on over a restart of the counter."""

    def __init__(self) -> None:
        self._newest: WheelReading | None = None
        self._left_offset_rad = 0.0
        self._right_offset_rad = 0.0

    def add_sample(self, sample: WheelSample) -> WheelReading | WheelReason:
        """Return the reading of a sample, or why there is none.

        Angles that jump further than any wheel turns are taken as a restarted counter: no motion, new zero.
        """
        left_speed, right_speed = sample.left_speed_rad_s, sample.right_speed_rad_s
        angles = (sample.left_angle_rad, sample.right_angle_rad)
        if not all(map(math.isfinite, (*angles, left_speed, right_speed))):
            return WheelReason.NOT_FINITE
        if (
            max(map(abs, angles)) > MAX_WHEEL_ANGLE_RAD
            or max(abs(left_speed), abs(right_speed)) > MAX_WHEEL_SPEED_RAD_S
        ):
            return WheelReason.OUT_OF_RANGE
        if sample.t_ns > sample.received_ns + FUTURE_TOLERANCE_NS:
            return WheelReason.FUTURE
        after_gap = restarted = False
        before = self._newest
        if before is not None:
            elapsed_ns = sample.t_ns - before.t_ns
            if elapsed_ns <= 0:
                return WheelReason.OUT_OF_ORDER
            after_gap = elapsed_ns > MAX_SAMPLE_GAP_NS
            bound_rad = MAX_WHEEL_SPEED_RAD_S * elapsed_ns * 1e-9 + JUMP_MARGIN_RAD
            left_turn = angles[0] + self._left_offset_rad - before.left_rad
            right_turn = angles[1] + self._right_offset_rad - before.right_rad
            restarted = max(abs(left_turn), abs(right_turn)) > bound_rad
            if restarted:
                self._left_offset_rad = before.left_rad - angles[0]
                self._right_offset_rad = before.right_rad - angles[1]
        self._newest = WheelReading(
            sample.t_ns,
            angles[0] + self._left_offset_rad,
            angles[1] + self._right_offset_rad,
            left_speed,
            right_speed,
            after_gap,
            restarted,
        )
        return self._newest


Flat9 = tuple[float, float, float, float, float, float, float, float, float]
_INDEPENDENT: Flat9 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

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
        """Mean of the belief: x, y (m), yaw (rad)."""
        return Pose(self.x_m, self.y_m, self.yaw_rad)

    @property
    def covariance(self) -> Matrix3:
        """The whole covariance as nested tuples, symmetric to the bit."""
        xx, xy, xt, yy, yt, tt = self.xx, self.xy, self.xt, self.yy, self.yt, self.tt
        if self.sensitivity is not None:
            wxx, wxy, wxt, wyy, wyt, wtt = covariance_by_parameters(self.sensitivity)
            return (xx + wxx, xy + wxy, xt + wxt), (xy + wxy, yy + wyy, yt + wyt), (xt + wxt, yt + wyt, tt + wtt)
        return (xx, xy, xt), (xy, yy, yt), (xt, yt, tt)


def covariance_by_parameters(sensitivity: Flat9) -> tuple[float, float, float, float, float, float]:
    """Return the entries xx, xy, xt, yy, yt, tt of W W'."""
    x0, x1, x2, y0, y1, y2, t0, t1, t2 = sensitivity
    return (
        x0 * x0 + x1 * x1 + x2 * x2,
        x0 * y0 + x1 * y1 + x2 * y2,
        x0 * t0 + x1 * t1 + x2 * t2,
        y0 * y0 + y1 * y1 + y2 * y2,
        y0 * t0 + y1 * t1 + y2 * t2,
        t0 * t0 + t1 * t1 + t2 * t2,
    )


class MotionModel(msgspec.Struct, frozen=True, gc=False):
    """Parameters of the prediction by odometry.

    Geometry; slip as variance per metre rolled or radian turned (so that it does not depend on the sampling rate); and
    a square root of the covariance of (wheel_radius_m, axial_distance_m, x_icr_m), 3x3 row by row, or None if they are
    known.
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
    """Return a belief with independent x, y (the same variance, m^2) and yaw (rad^2), independent of the parameters."""
    sensitivity = None if model.parameter_root is None else _INDEPENDENT
    x, y, yaw = pose.x_m, pose.y_m, wrap(pose.yaw_rad)
    return PoseBelief(x, y, yaw, position_variance, 0.0, 0.0, position_variance, 0.0, yaw_variance, sensitivity)


def rebased(belief: PoseBelief, model: MotionModel) -> PoseBelief:
    """Return the belief under other parameters, whose error is independent of what those before have caused."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = belief.covariance
    sensitivity = None if model.parameter_root is None else _INDEPENDENT
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
