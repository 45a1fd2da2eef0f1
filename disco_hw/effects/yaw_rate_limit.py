"""Yaw-rate limit: the drive cuts how fast it is asked to turn."""

from __future__ import annotations

import math
from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function


class YawRateLimit:
    """The commanded yaw rate r (u_R - u_L) / a is cut at +- the limit; the mean of the wheel speeds is kept."""

    name = "yaw_rate_limit"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.COMMAND
    order = 20
    parameters = (Parameter("limit_rad_s", "rad/s", 0.05, 20.0, 1.0, neutral=math.inf, starts=(0.5, 2.0)),)
    excitation = "turning on the spot, fast"
    script = "spins"
    sentence = "the robot never turns faster than {limit_rad_s:.2f} rad/s, whatever the command"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Largest half difference of the two commands (rad/s), (L,)."""
        return (values[:, 0] * base[:, 1] / (2.0 * base[:, 0]),)


@scalar_function
def term(left: Any, right: Any, coefficients: Any) -> Any:
    """Commands that are left of the two commands (rad/s)."""
    if coefficients is None:
        return left, right
    (limit,) = coefficients
    half = cast_like(0.5, left)
    mean, difference = half * (left + right), half * (right - left)
    difference = min(max(difference, -limit), limit)
    return mean - difference, mean + difference


EFFECT = YawRateLimit()
