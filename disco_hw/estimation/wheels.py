"""From wheel samples to continuous wheel readings: what is refused, gaps, restarted counters."""

from __future__ import annotations

import enum
import math

import msgspec

from drivers.types import WheelSample

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
