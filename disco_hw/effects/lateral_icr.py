"""Lateral ICR: the centre of rotation lies off the middle line."""

from __future__ import annotations

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(forward: Value, turn: Value, values: Values) -> Value:
    """v_x -> v_x + offset omega: the instantaneous centre of rotation lies this far to the left."""
    (offset_m,) = values
    omega = 2.0 * turn
    return forward + offset_m * omega


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Forward speed per half of the yaw rate, (L,)."""
    return (2.0 * values[:, 0],)


@scalar_function
def term(forward: float, turn: float, coefficients: tuple[float] | None) -> float:
    """Forward speed (m/s) at half the yaw rate `turn` (rad/s)."""
    if coefficients is None:
        return forward
    (offset,) = coefficients
    return forward + offset * turn


EFFECT = Effect(
    name="lateral_icr",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.FORWARD,
    order=160,
    parameters=(Parameter("offset_m", "m", -1.0, 1.0, 0.0, realistic=0.015),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    symptoms=(Symptom.FORWARD_WITH_TURNING, Symptom.LEFT_UNLIKE_RIGHT),
    excitation="turning on the spot, both ways",
    script="spins",
    sentence="the robot turns about a point {offset_m:+.3f} m to the left of its middle line",
)
