"""Turn slip: the faster the robot turns, the more of the turn is lost."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import cast_like, scalar_function

# Chosen: a limit, so that an extreme parameter leaves a robot that still turns.
LEAST_KEPT = 0.5


def plain(turn: Value, values: Values) -> Value:
    """Map omega to omega (1 - k |omega|), at most half of it lost (or doubled)."""
    (k_s,) = values
    omega = 2.0 * turn
    return 0.5 * omega * np.clip(1.0 - k_s * np.abs(omega), 0.5, 2.0)


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Loss per half of the yaw rate, (L,)."""
    return (2.0 * values[:, 0],)


@scalar_function
def term(turn: float, coefficients: tuple[float] | None) -> float:
    """Half the yaw rate that is left of half a yaw rate (rad/s)."""
    if coefficients is None:
        return turn
    (k,) = coefficients
    kept = cast_like(1.0, turn) - k * abs(turn)
    return turn * min(max(kept, cast_like(LEAST_KEPT, turn)), cast_like(1.0 / LEAST_KEPT, turn))


EFFECT = Effect(
    name="turn_slip",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.TURN,
    order=130,
    parameters=(Parameter("k_s", "s/rad", -2.0, 2.0, 0.05, realistic=0.04),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    may_turn_more=True,
    symptoms=(Symptom.LESS_TURN_AT_SPEED,),
    excitation="turning on the spot at two rates, both ways",
    script="spins",
    sentence="turning slips: {k_s:.1%} of the turn is lost for every rad/s of it",
)
