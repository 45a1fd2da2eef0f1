"""Turning that builds up slowly and falls fast: beside the scrub the drive has little torque to spare."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(
    left: Value, right: Value, end_left: Value, end_right: Value, mean_left: Value, mean_right: Value,
    wheel_left: Value, wheel_right: Value, values: Values, step_s: float,
) -> tuple[Value, Value, Value, Value]:  # fmt: skip
    """Half the difference of the wheels, d, grows in size by no more than the limit; up to `immediate` it is free.

    A motor of largest torque T against a scrub S turns the robot up with T - S and down with T + S, of which only the
    first is little (Wong, Theory of Ground Vehicles, 2008, ch. 6). While d lacks l of what is aimed for, motors that
    give all they have leave the mean of both sides where it is, as long as it lies within l of its own aim; `shared`
    is the part of l for which that is so.
    """
    limit, immediate, shared = values
    before, mean_before = (wheel_right - wheel_left) / 2.0, (wheel_left + wheel_right) / 2.0

    def within(turning: Value, within_s: float) -> Value:
        most = np.maximum(before, immediate) + limit * within_s
        least = np.minimum(before, -immediate) - limit * within_s
        return np.clip(turning, least, most)

    turning = within((end_right - end_left) / 2.0, step_s)
    mean_turning = within((mean_right - mean_left) / 2.0, step_s / 2.0)
    lacking = shared * np.abs((right - left) / 2.0 - turning)
    to_go = np.abs((left + right) / 2.0 - mean_before)
    kept = np.maximum(to_go - lacking, 0.0) / np.maximum(to_go, 1e-9)
    middle = mean_before + kept * ((end_left + end_right) / 2.0 - mean_before)
    mean_middle = mean_before + kept * ((mean_left + mean_right) / 2.0 - mean_before)
    return middle - turning, middle + turning, mean_middle - mean_turning, mean_middle + mean_turning


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Return half the difference's largest growth in a step, what it reaches at once (rad/s), the share; (L,) each."""
    return values[:, 0] * step_s, values[:, 1], values[:, 2]


@scalar_function
def term(
    left: float, right: float, end_left: float, end_right: float, mean_left: float, mean_right: float,
    wheel_left: float, wheel_right: float, coefficients: tuple[float, float, float] | None,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Wheel speeds at the end of the step, left and right, and their means over it (rad/s)."""
    if coefficients is None:
        return end_left, end_right, mean_left, mean_right
    growth, immediate, shared = coefficients
    half, none = cast_like(0.5, end_left), cast_like(0.0, end_left)
    before, mean_before = half * (wheel_right - wheel_left), half * (wheel_left + wheel_right)
    most, least = max(before, immediate), min(before, -immediate)
    turning = min(max(half * (end_right - end_left), least - growth), most + growth)
    # A ramp that takes the whole step has gone half its way on average.
    mean_turning = min(max(half * (mean_right - mean_left), least - half * growth), most + half * growth)
    to_go = abs(half * (left + right) - mean_before)
    lacking = shared * abs(half * (right - left) - turning)
    kept = max(to_go - lacking, none) / max(to_go, cast_like(1e-9, end_left))
    middle = mean_before + kept * (half * (end_left + end_right) - mean_before)
    mean_middle = mean_before + kept * (half * (mean_left + mean_right) - mean_before)
    return middle - turning, middle + turning, mean_middle - mean_turning, mean_middle + mean_turning


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: the fastest turn that was commanded takes one to four seconds."""
    half = 0.5 * float(np.abs(driven.commands[:, 1] - driven.commands[:, 0]).max(initial=0.0))
    return ((half, 0.0, 0.0), (half, 0.0, 1.0), (half / 4.0, half / 4.0, 0.0)) if half > 0.1 else ()


EFFECT = Effect(
    name="turning_buildup",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.RESPONSE,
    order=78,
    parameters=(
        Parameter("limit_rad_s2", "rad/s^2", 0.02, 200.0, 1.0, neutral=math.inf, realistic=1.5),
        Parameter("at_once_rad_s", "rad/s", 0.0, 5.0, 0.0),
        Parameter("shared", "1", 0.0, 2.0, 0.0),
    ),
    plain=plain,
    coefficients=coefficients,
    term=term,
    starts=starts,
    trials=(20.0, 10.0, 7.0, 5.0, 3.5, 2.5, 1.5, 1.0, 0.5),
    excitation="turning on the spot for some seconds, both ways, with pauses",
    script="spins",
    sentence="turning builds up slowly and falls fast: the wheels' difference grows by no more than "
    "{limit_rad_s2:.2f} rad/s^2 on each side, beyond {at_once_rad_s:.2f} rad/s",
)
