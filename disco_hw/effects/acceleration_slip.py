"""Acceleration slip: wheels run ahead of the body when it speeds up and behind it when it brakes."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import cast_like, scalar_function

# Chosen: a limit, so that an extreme parameter leaves a robot that still moves.
LARGEST_SLIP = 0.6


def plain(forward: Value, change: Value, values: Values, geometry: Values, step_s: float) -> Value:
    """Map v to v - k |v| dv/dt, at most 60 % of it."""
    (k_s2_m,), (radius, _, _) = values, geometry
    acceleration = radius * change / 2.0 / step_s
    loss: Value = np.abs(forward) * np.clip(k_s2_m * acceleration, -0.6, 0.6)
    return forward - loss


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Slip per change of the two wheel speeds' sum over a step, (L,)."""
    return (values[:, 0] * 0.5 * base[:, 0] / step_s,)


@scalar_function
def term(forward: float, change: float, coefficients: tuple[float] | None) -> float:
    """Forward speed (m/s) while the sum of the wheel speeds changes by `change` (rad/s) over the step."""
    if coefficients is None:
        return forward
    (k,) = coefficients
    largest = cast_like(LARGEST_SLIP, forward)
    return forward - abs(forward) * min(max(k * change, -largest), largest)


EFFECT = Effect(
    name="acceleration_slip",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.FORWARD,
    order=140,
    parameters=(Parameter("k_s2_m", "s^2/m", -5.0, 5.0, 0.1, realistic=0.08),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    symptoms=(Symptom.DELAYED_POSITIONS, Symptom.SHORTER_AT_SPEED),
    excitation="start-stops on a straight, forward and back",
    script="starts",
    sentence="speeding up slips: {k_s2_m:.1%} of the speed is lost for every m/s^2",
)
