"""Wheel odometry: continuous wheel readings from samples, and the exact arc that they make, with its derivatives."""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

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
    SI units, the error being constant over the run; None means exactly known. Raises ValueError on geometry or a
    covariance that cannot be.
    """

    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float
    covariance: Matrix3 | None = None

    def __post_init__(self) -> None:
        for name in ("wheel_radius_m", "axial_distance_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} = {value} must be finite and positive")
        if not math.isfinite(self.x_icr_m):
            raise ValueError(f"x_icr_m = {self.x_icr_m} must be finite")
        if self.covariance is None:
            return
        matrix = np.array(self.covariance, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.array_equal(matrix, matrix.T):
            raise ValueError("covariance must be a finite symmetric 3x3 matrix")
        if np.linalg.eigvalsh(matrix)[0] < -1e-12 * float(np.trace(matrix)):
            raise ValueError("covariance must not have negative eigenvalues")


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
    """Why a wheel sample was refused."""

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

    def take(self, sample: WheelSample) -> WheelReading | WheelReason:
        """The reading of a sample, or why there is none.

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
