"""Slope: the ground pulls the robot in one direction of the world."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function

ONSET_M_S = 0.02


class Slope:
    """A drift in the world frame while the wheels turn; it fades in below a rim speed of 0.02 m/s."""

    name = "slope"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.WORLD
    order = 170
    parameters = (
        Parameter("drift_x_m_s", "m/s", -1.0, 1.0, 0.0, realistic=0.008),
        Parameter("drift_y_m_s", "m/s", -1.0, 1.0, 0.0),
    )
    excitation = "straights and turns in all directions"
    script = "straights"
    sentence = "a moving robot drifts with ({drift_x_m_s:+.3f}, {drift_y_m_s:+.3f}) m/s in the world frame"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Drift in a step along x and y (m), and the reciprocal of the onset in wheel speed (s/rad); each (L,)."""
        return values[:, 0] * step_s, values[:, 1] * step_s, 0.5 * base[:, 0] / ONSET_M_S


@scalar_function
def term(x: Any, y: Any, wheel_sum: Any, difference: Any, coefficients: Any) -> Any:
    """Position (m) after a step's drift; of the wheel speeds sum and difference (rad/s)."""
    if coefficients is None:
        return x, y
    drift_x, drift_y, scale = coefficients
    # |left| + |right| is the larger of |left + right| and |left - right|.
    part = min(scale * max(abs(wheel_sum), abs(difference)), cast_like(1.0, x))
    return x + part * drift_x, y + part * drift_y


EFFECT = Slope()
