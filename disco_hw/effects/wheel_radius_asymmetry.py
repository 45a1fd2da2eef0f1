"""Wheel-radius asymmetry: one side's wheels are larger than the other's."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class WheelRadiusAsymmetry:
    """r_R = r (1 + ratio), r_L = r (1 - ratio)."""

    name = "wheel_radius_asymmetry"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.ROLLING
    order = 110
    parameters = (Parameter("ratio", "1", -0.5, 0.5, 0.0, realistic=0.008),)
    excitation = "long straights, forward and back"
    script = "straights"
    sentence = "the right wheels are {ratio:+.2%} larger than the mean and the left ones as much smaller"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """The ratio, (L,)."""
        return (values[:, 0],)


@scalar_function
def term(wheel_sum: Any, difference: Any, coefficients: Any) -> Any:
    """Sum and difference (right minus left) of the wheel speeds that equal wheels would need (rad/s)."""
    if coefficients is None:
        return wheel_sum, difference
    (ratio,) = coefficients
    return wheel_sum + ratio * difference, difference + ratio * wheel_sum


EFFECT = WheelRadiusAsymmetry()
