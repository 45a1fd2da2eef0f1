"""Wheel gain: the drive answers with more or less than it was asked for."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class WheelGain:
    """u -> u (1 + gain), for each side its own."""

    name = "wheel_gain"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.COMMAND
    order = 40
    parameters = (Parameter("left", "1", -0.9, 2.0, 0.0, realistic=0.02), Parameter("right", "1", -0.9, 2.0, 0.0))
    excitation = "straights and turns at several speeds"
    script = "straights"
    sentence = "the left wheel turns {left:+.1%} and the right wheel {right:+.1%} from what was commanded"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Factors of the left and right command, each (L,)."""
        return 1.0 + values[:, 0], 1.0 + values[:, 1]


@scalar_function
def term(left: Any, right: Any, coefficients: Any) -> Any:
    """Wheel speeds that the commands ask for (rad/s)."""
    if coefficients is None:
        return left, right
    factor_left, factor_right = coefficients
    return left * factor_left, right * factor_right


EFFECT = WheelGain()
