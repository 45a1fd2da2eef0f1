"""Speed limit: the drive cuts each wheel's command."""

from __future__ import annotations

import math
from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class SpeedLimit:
    """Each wheel's command is cut at +- the limit."""

    name = "speed_limit"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.COMMAND
    order = 30
    parameters = (Parameter("limit_rad_s", "rad/s", 0.1, 100.0, 6.0, neutral=math.inf, starts=(3.0, 10.0)),)
    excitation = "straights and turns at full speed"
    script = "straights"
    sentence = "no wheel turns faster than {limit_rad_s:.2f} rad/s"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """The limit, (L,)."""
        return (values[:, 0],)


@scalar_function
def term(command: Any, coefficients: Any) -> Any:
    """Command that is left of a wheel's command (rad/s)."""
    if coefficients is None:
        return command
    (limit,) = coefficients
    return min(max(command, -limit), limit)


EFFECT = SpeedLimit()
