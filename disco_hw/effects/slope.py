"""Slope: the ground pulls the robot in one direction of the world."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import cast_like, scalar_function

# Chosen: a robot at rest is not pulled, and one that begins to move is pulled without a jump.
ONSET_M_S = 0.02


def plain(
    x: Value, y: Value, wheel_sum: Value, difference: Value, values: Values, geometry: Values, step_s: float
) -> tuple[Value, Value]:
    """Return a drift in the world frame while the wheels turn; it fades in below a rim speed of 0.02 m/s."""
    (drift_x_m_s, drift_y_m_s), (radius, _, _) = values, geometry
    left, right = (wheel_sum - difference) / 2.0, (wheel_sum + difference) / 2.0
    rim_speed = radius * (np.abs(left) + np.abs(right)) / 2.0
    part = np.minimum(rim_speed / 0.02, 1.0)
    return x + part * drift_x_m_s * step_s, y + part * drift_y_m_s * step_s


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Drift in a step along x and y (m), and the reciprocal of the onset in wheel speed (s/rad); each (L,)."""
    return values[:, 0] * step_s, values[:, 1] * step_s, 0.5 * base[:, 0] / ONSET_M_S


@scalar_function
def term(
    x: float, y: float, wheel_sum: float, difference: float, coefficients: tuple[float, float, float] | None
) -> tuple[float, float]:
    """Position (m) after a step's drift; of the wheel speeds sum and difference (rad/s)."""
    if coefficients is None:
        return x, y
    drift_x, drift_y, scale = coefficients
    # |left| + |right| is the larger of |left + right| and |left - right|.
    part = min(scale * max(abs(wheel_sum), abs(difference)), cast_like(1.0, x))
    return x + part * drift_x, y + part * drift_y


EFFECT = Effect(
    name="slope",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.WORLD,
    order=170,
    parameters=(
        Parameter("drift_x_m_s", "m/s", -1.0, 1.0, 0.0, realistic=0.008),
        Parameter("drift_y_m_s", "m/s", -1.0, 1.0, 0.0),
    ),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    symptoms=(Symptom.DOWNHILL,),
    excitation="straights and turns in all directions",
    script="straights",
    sentence="a moving robot drifts with ({drift_x_m_s:+.3f}, {drift_y_m_s:+.3f}) m/s in the world frame",
)
