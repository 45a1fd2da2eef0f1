"""Turning point: to the left the robot turns about another point than to the right, further ahead or back."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(turn: Value, values: Values) -> Value:
    """v_y -> v_y + ahead |omega|.

    A tyre that holds less, or carries less, leaves the middle of the drag to the others, and a turn the other way drags
    them the other way.
    """
    (ahead_m,) = values
    return ahead_m * np.abs(2.0 * turn)


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Lateral speed for half of the yaw rate (m), (L,)."""
    return (2.0 * values[:, 0],)


@scalar_function
def term(turn: float, coefficients: tuple[float] | None) -> float | None:
    """Lateral speed of the axle (m/s), or None without the effect."""
    if coefficients is None:
        return None
    (ahead,) = coefficients
    return ahead * abs(turn)


EFFECT = Effect(
    name="turning_point",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.LATERAL,
    order=152,
    parameters=(Parameter("ahead_m", "m", -0.5, 0.5, 0.0, realistic=0.01),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    symptoms=(Symptom.LEFT_UNLIKE_RIGHT,),
    excitation="turns on the spot both ways",
    script="spins",
    sentence="left turns are about a point {ahead_m:+.3f} m further back, and right ones as much further ahead",
)
