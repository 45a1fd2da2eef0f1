"""Acceleration limit: the drive ramps each wheel from one speed to another; many brake at once at a stop."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function

# Below such an aim a wheel is to stop (rad/s).
_STOP_RAD_S = 0.02
# A stop that takes no more than this share of the time is at once.
_LEAST_SHARE = 1e-3
# Chosen: below this share no operator sees a ramp in a stop.
_NEGLIGIBLE_SHARE = 0.05
# How long the fastest speed that was commanded takes to reach, where a fit begins (s).
RISES_S = (0.3, 1.0, 4.0)


def plain(
    left: Value, right: Value, end_left: Value, end_right: Value, mean_left: Value, mean_right: Value,
    wheel_left: Value, wheel_right: Value, values: Values, step_s: float,
) -> tuple[Value, Value, Value, Value]:  # fmt: skip
    """Cut the change of each wheel's speed over a step; one that is to stop takes `stop_share` of the time."""
    limit, stop_share = values

    def within(aim: Value, speed: Value, before: Value, within_s: float) -> Value:
        change = np.where(np.abs(aim) < 0.02, limit / np.maximum(stop_share, 1e-3), limit) * within_s
        return np.clip(speed, before - change, before + change)

    return (
        within(left, end_left, wheel_left, step_s),
        within(right, end_right, wheel_right, step_s),
        within(left, mean_left, wheel_left, step_s / 2.0),
        within(right, mean_right, wheel_right, step_s / 2.0),
    )


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Largest change of a wheel's speed over a step, and of one that is to stop (rad/s), (L,) each."""
    most = values[:, 0] * step_s
    return most, most / np.maximum(values[:, 1], _LEAST_SHARE)


@scalar_function
def term(
    left: float, right: float, end_left: float, end_right: float, mean_left: float, mean_right: float,
    wheel_left: float, wheel_right: float, coefficients: tuple[float, float] | None,
) -> tuple[float, float, float, float]:  # fmt: skip
    """Wheel speeds at the end of the step, left and right, and their means over it (rad/s)."""
    if coefficients is None:
        return end_left, end_right, mean_left, mean_right
    ramp, stop = coefficients
    half, rest = cast_like(0.5, end_left), cast_like(_STOP_RAD_S, end_left)
    most_left = stop if abs(left) < rest else ramp
    most_right = stop if abs(right) < rest else ramp
    end_left = min(max(end_left, wheel_left - most_left), wheel_left + most_left)
    end_right = min(max(end_right, wheel_right - most_right), wheel_right + most_right)
    # A ramp that takes the whole step has gone half its way on average.
    most_left, most_right = half * most_left, half * most_right
    mean_left = min(max(mean_left, wheel_left - most_left), wheel_left + most_left)
    mean_right = min(max(mean_right, wheel_right - most_right), wheel_right + most_right)
    return end_left, end_right, mean_left, mean_right


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: the fastest wheel that was commanded takes a while, and stops alike or at once."""
    largest = driven.largest_speed_rad_s
    if largest < 0.1:
        return ()
    ramps = [largest / rise_s for rise_s in RISES_S]
    return tuple((ramp, stop_share) for ramp in ramps for stop_share in (1.0, 0.05))


def stop_wording(values: Mapping[str, float]) -> str:
    """Return the text on how long a stop takes."""
    is_immediate = values["stop_share"] <= _NEGLIGIBLE_SHARE
    return "a wheel stops at once" if is_immediate else "a stop takes {stop_share:.2f} of that time"


EFFECT = Effect(
    name="acceleration_limit",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.RESPONSE,
    order=75,
    parameters=(
        Parameter("limit_rad_s2", "rad/s^2", 0.05, 200.0, 5.0, neutral=math.inf, realistic=10.0),
        Parameter("stop_share", "1", 0.0, 5.0, 1.0, neutral=1.0, expected=1.0, least_fitted=-0.2),
    ),
    plain=plain,
    coefficients=coefficients,
    term=term,
    starts=starts,
    trials=(50.0, 30.0, 20.0, 12.0, 8.0, 5.0, 3.0, 2.0, 1.0, 0.5),
    excitation="steps of the wheel command, from rest and back to it",
    script="starts",
    sentence="each wheel's speed changes by no more than {limit_rad_s2:.2f} rad/s^2",
    other_symptoms=(("stop_share", stop_wording),),
)
