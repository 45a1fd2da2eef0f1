"""Side slip: the body is carried outwards in a turn."""

from __future__ import annotations

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(forward: Value, turn: Value, values: Values) -> Value:
    """v_y -> v_y - k v omega."""
    (k_s,) = values
    omega = 2.0 * turn
    return -k_s * forward * omega


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Lateral speed per forward speed and half of the yaw rate, (L,)."""
    return (-2.0 * values[:, 0],)


@scalar_function
def term(forward: float, turn: float, coefficients: tuple[float] | None) -> float | None:
    """Lateral speed of the axle (m/s), or None without the effect."""
    if coefficients is None:
        return None
    (k,) = coefficients
    return k * forward * turn


EFFECT = Effect(
    name="side_slip",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.LATERAL,
    order=150,
    parameters=(Parameter("k_s", "s", -2.0, 2.0, 0.05, realistic=0.06),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    symptoms=(Symptom.SIDEWAYS_IN_FAST_TURNS,),
    excitation="circles at two speeds, both ways",
    script="curves",
    sentence="in a turn the body slides outwards with {k_s:.3f} s times speed and yaw rate",
)
