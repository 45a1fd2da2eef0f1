"""Yaw-rate limit: the drive limits the commanded yaw rate."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(left: Value, right: Value, values: Values, geometry: Values) -> tuple[Value, Value]:
    """Cut the commanded yaw rate r (u_R - u_L) / a at +- the limit; the mean of the wheel speeds is kept."""
    (limit,), (radius, axial, _) = values, geometry
    rate = radius * (right - left) / axial
    difference = np.clip(rate, -limit, limit) * axial / radius
    mean = (left + right) / 2.0
    return mean - difference / 2.0, mean + difference / 2.0


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Largest half difference of the two commands (rad/s), (L,)."""
    return (values[:, 0] * base[:, 1] / (2.0 * base[:, 0]),)


@scalar_function
def term(left: float, right: float, coefficients: tuple[float] | None) -> tuple[float, float]:
    """Commands that are left of the two commands (rad/s)."""
    if coefficients is None:
        return left, right
    (limit,) = coefficients
    half = cast_like(0.5, left)
    mean, difference = half * (left + right), half * (right - left)
    difference = min(max(difference, -limit), limit)
    return mean - difference, mean + difference


def limited(commands: Array, geometry: tuple[float, float]) -> Array:
    """Yaw rate that was asked for (rad/s), (N,)."""
    return np.asarray(np.abs(commands[:, 1] - commands[:, 0]) * geometry[0] / geometry[1])


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: a part of what was commanded is cut."""
    largest = driven.largest_yaw_rate_rad_s
    return tuple((share * largest,) for share in (0.92, 0.75, 0.5)) if largest > 0.1 else ()


EFFECT = Effect(
    name="yaw_rate_limit",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=20,
    parameters=(Parameter("limit_rad_s", "rad/s", 0.05, 20.0, 1.0, neutral=math.inf, realistic=1.2),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    limited=limited,
    starts=starts,
    excitation="turning on the spot, fast",
    script="spins",
    sentence="the robot never turns faster than {limit_rad_s:.2f} rad/s, whatever the command",
)
