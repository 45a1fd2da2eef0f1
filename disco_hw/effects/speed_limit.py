"""Speed limit: the drive cuts each wheel's command."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import scalar_function


def plain(command: Value, values: Values) -> Value:
    """Cut each wheel's command at +- the limit."""
    (limit,) = values
    return np.clip(command, -limit, limit)


@scalar_function
def term(command: float, coefficients: tuple[float] | None) -> float:
    """Command that is left of a wheel's command (rad/s)."""
    if coefficients is None:
        return command
    (limit,) = coefficients
    return min(max(command, -limit), limit)


def limited(commands: Array, geometry: tuple[float, float]) -> Array:
    """Speed of the faster wheel, (N,)."""
    return np.asarray(np.abs(commands).max(axis=1))


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: a part of what was commanded is cut."""
    largest = driven.largest_speed_rad_s
    return tuple((share * largest,) for share in (0.92, 0.75, 0.5)) if largest > 0.1 else ()


EFFECT = Effect(
    name="speed_limit",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=30,
    parameters=(Parameter("limit_rad_s", "rad/s", 0.1, 100.0, 6.0, neutral=math.inf),),
    plain=plain,
    term=term,
    limited=limited,
    starts=starts,
    excitation="straights and turns at full speed",
    script="straights",
    sentence="no wheel turns faster than {limit_rad_s:.2f} rad/s",
)
