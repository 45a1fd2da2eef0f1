"""Load transfer: speeding up presses the rear tyres down, and the robot turns about another point."""

from __future__ import annotations

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import scalar_function


def plain(turn: Value, change: Value, values: Values, geometry: Values, step_s: float) -> Value:
    """v_y -> v_y + k dv/dt omega.

    The middle of four tyres that are dragged sideways lies where their loads have it, and an acceleration shifts load
    from the front ones to the rear ones (Wong, Theory of Ground Vehicles, 2008, ch. 6).
    """
    (k_s2,), (radius, _, _) = values, geometry
    acceleration = radius * change / 2.0 / step_s
    return k_s2 * acceleration * 2.0 * turn


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Lateral speed for half of the yaw rate, per change of the two wheel speeds' sum over a step (m s), (L,)."""
    return (values[:, 0] * base[:, 0] / step_s,)


@scalar_function
def term(turn: float, change: float, coefficients: tuple[float] | None) -> float | None:
    """Lateral speed of the axle (m/s), or None without the effect; of the change of the wheels' sum (rad/s)."""
    if coefficients is None:
        return None
    (k,) = coefficients
    return k * change * turn


EFFECT = Effect(
    name="load_transfer",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.LATERAL,
    order=154,
    parameters=(Parameter("k_s2", "s^2", -1.0, 1.0, 0.0, realistic=0.04),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    excitation="speeding up and braking in arcs",
    script="curves",
    sentence="the point that the robot turns about moves back by {k_s2:.3f} m for every m/s^2 of speeding up",
)
