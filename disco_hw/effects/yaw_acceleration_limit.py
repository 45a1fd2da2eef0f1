"""Yaw-acceleration limit: the drive limits the change of the yaw rate in a second."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function

# How long the fastest turn that was commanded takes to reach, where a fit begins (s).
RISES_S = (0.15, 0.5, 1.2)


def plain(
    end_left: Value, end_right: Value, mean_left: Value, mean_right: Value, wheel_left: Value, wheel_right: Value,
    values: Values, geometry: Values, step_s: float,
) -> tuple[Value, Value, Value, Value]:  # fmt: skip
    """Cut the change of the yaw rate r (w_R - w_L) / a over a step; the mean of the wheel speeds is kept."""
    (limit,), (radius, axial, _) = values, geometry
    to_rate = radius / axial

    def within(left: Value, right: Value, within_s: float) -> tuple[Value, Value]:
        before, change = to_rate * (wheel_right - wheel_left), limit * within_s
        rate = np.clip(to_rate * (right - left), before - change, before + change)
        mean = (left + right) / 2.0
        return mean - rate / to_rate / 2.0, mean + rate / to_rate / 2.0

    return *within(end_left, end_right, step_s), *within(mean_left, mean_right, step_s / 2.0)


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Largest change over a step of half the difference of the two wheel speeds (rad/s), (L,)."""
    return (values[:, 0] * step_s * base[:, 1] / (2.0 * base[:, 0]),)


@scalar_function
def term(
    end_left: float, end_right: float, mean_left: float, mean_right: float, wheel_left: float, wheel_right: float,
    coefficients: tuple[float] | None,
) -> tuple[float, float, float, float]:  # fmt: skip
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


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: the fastest turn that was commanded takes a while."""
    largest = driven.largest_yaw_rate_rad_s
    return tuple((0.92 * largest / rise_s,) for rise_s in RISES_S) if largest > 0.1 else ()


EFFECT = Effect(
    name="yaw_acceleration_limit",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.RESPONSE,
    order=80,
    parameters=(Parameter("limit_rad_s2", "rad/s^2", 0.05, 200.0, 2.0, neutral=math.inf, realistic=3.0),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    starts=starts,
    trials=(20.0, 10.0, 7.0, 5.0, 3.5, 2.5, 1.5, 1.0, 0.5),
    excitation="turning on the spot, fast, from one side to the other",
    script="spins",
    sentence="the robot's turning speeds up and slows down by no more than {limit_rad_s2:.2f} rad/s^2",
)
