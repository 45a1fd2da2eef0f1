"""The last limits before a command leaves the host: wheel speed, wheel acceleration, nothing that is not a number.

The second of three layers: the planner samples within bounds, this governor holds the wheels to them whatever the
planner says, and the firmware enforces its own.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import msgspec

# A tick that comes late may move the command by half a period more than usual, never by the whole time missed.
_LARGEST_STEP_PERIODS = 1.5


class Limited(enum.Flag):
    """Why a command differs from what was desired; empty if it does not."""

    NONE = 0
    SPEED = enum.auto()
    ACCELERATION = enum.auto()
    PERIOD = enum.auto()
    NOT_FINITE = enum.auto()


@dataclass(frozen=True, slots=True)
class WheelLimits:
    """Limits of each wheel: rad/s, and rad/s^2 away from and towards standstill."""

    max_speed_rad_s: float
    max_acceleration_rad_s2: float
    max_deceleration_rad_s2: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive and finite, not {value}")


class Governed(msgspec.Struct, frozen=True, gc=False):
    """The command that may be sent (rad/s, left before right) and why it is not the desired one."""

    left_rad_s: float
    right_rad_s: float
    limited: Limited


class Governor:
    """Holds wheel commands within limits, from the command sent last.

    Speed: both wheels are scaled by one factor, so the curvature of the path is kept. Acceleration: the command moves
    along the straight line in wheel space from the last command to the desired one, as far as the slower-limited wheel
    allows, so neither wheel exceeds its limit and the direction of the change is kept.
    """

    def __init__(self, limits: WheelLimits, period_s: float) -> None:
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise ValueError(f"period_s must be positive and finite, not {period_s}")
        self._limits = limits
        self._largest_dt_s = _LARGEST_STEP_PERIODS * period_s
        self._left_rad_s = 0.0
        self._right_rad_s = 0.0
        self._not_finite_count = 0

    @property
    def not_finite_count(self) -> int:
        """Number of desired commands so far that held a NaN or an infinity."""
        return self._not_finite_count

    def reset(self) -> None:
        """Start again from standstill; to be called when no command is being sent and the robot has stopped."""
        self._left_rad_s = 0.0
        self._right_rad_s = 0.0

    def step(self, desired_left_rad_s: float, desired_right_rad_s: float, dt_s: float) -> Governed:
        """Return the command nearest to the desired one that the limits allow `dt_s` after the last one.

        A desired command that is not finite counts as standstill. A `dt_s` that is negative or not a
        number counts as none, one beyond 1.5 nominal periods as 1.5 periods.
        """
        limited = Limited.NONE
        left, right = desired_left_rad_s, desired_right_rad_s
        if not (math.isfinite(left) and math.isfinite(right)):
            self._not_finite_count += 1
            limited |= Limited.NOT_FINITE
            left, right = 0.0, 0.0

        top = self._limits.max_speed_rad_s
        fastest = max(abs(left), abs(right))
        if fastest > top:
            limited |= Limited.SPEED
            # Dividing first keeps the faster wheel at exactly the limit: fastest / fastest is 1.
            left, right = left / fastest * top, right / fastest * top

        # A NaN fails both comparisons of the clamp and counts as no time at all.
        dt = dt_s if 0.0 <= dt_s <= self._largest_dt_s else (self._largest_dt_s if dt_s > 0.0 else 0.0)
        if dt != dt_s:
            limited |= Limited.PERIOD

        fraction = min(
            1.0,
            self._allowed_fraction(self._left_rad_s, left, dt),
            self._allowed_fraction(self._right_rad_s, right, dt),
        )
        if fraction < 1.0:
            limited |= Limited.ACCELERATION
            left = self._left_rad_s + fraction * (left - self._left_rad_s)
            right = self._right_rad_s + fraction * (right - self._right_rad_s)
        self._left_rad_s, self._right_rad_s = left, right
        return Governed(left, right, limited)

    def _allowed_fraction(self, start: float, end: float, dt_s: float) -> float:
        """Return the part of the change from `start` to `end` that one wheel can make in `dt_s`; at least 1 if all."""
        change = abs(end - start)
        if change == 0.0:
            return 1.0
        if start * (end - start) >= 0.0:
            return self._limits.max_acceleration_rad_s2 * dt_s / change
        to_standstill_s = abs(start) / self._limits.max_deceleration_rad_s2
        if to_standstill_s >= dt_s:
            return self._limits.max_deceleration_rad_s2 * dt_s / change
        return (abs(start) + self._limits.max_acceleration_rad_s2 * (dt_s - to_standstill_s)) / change
