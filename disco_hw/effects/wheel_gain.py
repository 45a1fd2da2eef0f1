"""Wheel gain: the drive turns the wheels faster or slower than commanded."""

from __future__ import annotations

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import scalar_function


def plain(left: Value, right: Value, values: Values) -> tuple[Value, Value]:
    """Map u to u (1 + gain), for each side its own."""
    gain_left, gain_right = values
    return left * (1.0 + gain_left), right * (1.0 + gain_right)


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Factors of the left and right command, each (L,)."""
    return 1.0 + values[:, 0], 1.0 + values[:, 1]


@scalar_function
def term(left: float, right: float, coefficients: tuple[float, float] | None) -> tuple[float, float]:
    """Wheel speeds that the commands ask for (rad/s)."""
    if coefficients is None:
        return left, right
    factor_left, factor_right = coefficients
    return left * factor_left, right * factor_right


EFFECT = Effect(
    name="wheel_gain",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=40,
    parameters=(Parameter("left", "1", -0.9, 2.0, 0.0, realistic=0.02), Parameter("right", "1", -0.9, 2.0, 0.0)),
    plain=plain,
    coefficients=coefficients,
    term=term,
    may_turn_more=True,
    excitation="straights and turns at several speeds",
    script="straights",
    sentence="relative to its command, the left wheel turns {left:+.1%} and the right wheel {right:+.1%}",
)
