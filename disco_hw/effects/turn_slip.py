"""Turn slip: the faster it turns, the more of the turn is lost."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function

LEAST_KEPT = 0.5


class TurnSlip:
    """omega -> omega (1 - k |omega|), at most half of it lost (or doubled)."""

    name = "turn_slip"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.TURN
    order = 130
    parameters = (Parameter("k_s", "s/rad", -2.0, 2.0, 0.05, starts=(-0.05,), realistic=0.04),)
    excitation = "turning on the spot at two rates, both ways"
    script = "spins"
    sentence = "turning slips: {k_s:.1%} of the turn is lost for every rad/s of it"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Loss per half of the yaw rate, (L,)."""
        return (2.0 * values[:, 0],)


@scalar_function
def term(turn: Any, coefficients: Any) -> Any:
    """Half the yaw rate that is left of half a yaw rate (rad/s)."""
    if coefficients is None:
        return turn
    (k,) = coefficients
    kept = cast_like(1.0, turn) - k * abs(turn)
    return turn * min(max(kept, cast_like(LEAST_KEPT, turn)), cast_like(1.0 / LEAST_KEPT, turn))


EFFECT = TurnSlip()
