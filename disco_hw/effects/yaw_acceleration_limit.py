"""Yaw-acceleration limit: the drive turns the robot no faster than this from one yaw rate to another."""

from __future__ import annotations

import math
from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function


class YawAccelerationLimit:
    """The change of the yaw rate r (w_R - w_L) / a over a step is cut; the mean of the wheel speeds is kept."""

    name = "yaw_acceleration_limit"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.RESPONSE
    order = 80
    parameters = (
        Parameter("limit_rad_s2", "rad/s^2", 0.05, 200.0, 2.0, neutral=math.inf, starts=(1.0, 5.0), realistic=3.0),
    )
    excitation = "turning on the spot, fast, from one side to the other"
    script = "spins"
    sentence = "the robot's turning speeds up and slows down by no more than {limit_rad_s2:.2f} rad/s^2"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Largest change over a step of half the difference of the two wheel speeds (rad/s), (L,)."""
        return (values[:, 0] * step_s * base[:, 1] / (2.0 * base[:, 0]),)


@scalar_function
def term(
    end_left: Any, end_right: Any, mean_left: Any, mean_right: Any, wheel_left: Any, wheel_right: Any, coefficients: Any
) -> Any:
    """Wheel speeds at the end of the step, left and right, and their means over it (rad/s)."""
    if coefficients is None:
        return end_left, end_right, mean_left, mean_right
    (most,) = coefficients
    half = cast_like(0.5, end_left)
    before = half * (wheel_right - wheel_left)
    middle, turning = half * (end_left + end_right), half * (end_right - end_left)
    turning = min(max(turning, before - most), before + most)
    # A ramp that takes the whole step has gone half its way on average.
    mean_middle, mean_turning = half * (mean_left + mean_right), half * (mean_right - mean_left)
    mean_turning = min(max(mean_turning, before - half * most), before + half * most)
    return middle - turning, middle + turning, mean_middle - mean_turning, mean_middle + mean_turning


EFFECT = YawAccelerationLimit()
