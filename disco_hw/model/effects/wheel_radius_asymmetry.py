"""Wheel-radius asymmetry: one side's wheels are larger than the other's."""

from __future__ import annotations

from typing import Any

from disco_hw.model.effects.effect import Array, Channel
from disco_hw.model.jit import scalar_function
from disco_hw.model.parameter import Parameter


class WheelRadiusAsymmetry:
    """r_R = r (1 + ratio), r_L = r (1 - ratio)."""

    name = "wheel_radius_asymmetry"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    parameters = (Parameter("ratio", "1", -0.5, 0.5, 0.0),)
    excitation = "long straights, forward and back"
    sentence = "the right wheels are {ratio:+.2%} larger than the mean and the left ones as much smaller"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Factors of the left and right rim speed, each (L,)."""
        return 1.0 - values[:, 0], 1.0 + values[:, 0]


@scalar_function
def term(left: Any, right: Any, coefficients: Any) -> Any:
    """Wheel speeds that equal wheels would need for the same rim speeds (rad/s)."""
    if coefficients is None:
        return left, right
    factor_left, factor_right = coefficients
    return left * factor_left, right * factor_right


EFFECT = WheelRadiusAsymmetry()
