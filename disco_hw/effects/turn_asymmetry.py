"""Turn asymmetry: the robot turns further one way than the other, as with tyres of unequal grip."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(turn: Value, values: Values) -> Value:
    """Map omega to omega + share |omega|.

    The tyres that hold least are dragged most: with a worn one in front on the left the robot turns about another point
    to the left than to the right, and each side drags the other less or more.
    """
    (share,) = values
    return turn + share * np.abs(turn)


@scalar_function
def term(turn: float, coefficients: tuple[float] | None) -> float:
    """Half the yaw rate of half a yaw rate (rad/s)."""
    if coefficients is None:
        return turn
    (share,) = coefficients
    return turn + cast_like(share, turn) * abs(turn)


EFFECT = Effect(
    name="turn_asymmetry",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.TURN,
    order=125,
    parameters=(Parameter("share", "1", -0.5, 0.5, 0.0, realistic=0.05),),
    plain=plain,
    term=term,
    may_turn_more=True,
    symptoms=(Symptom.LEFT_UNLIKE_RIGHT,),
    excitation="turns both ways at the same rates",
    script="spins",
    sentence="the same wheel speeds turn the robot by {share:+.1%} of the turn further to the left",
)
