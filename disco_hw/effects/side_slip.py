"""Side slip: the body is carried outwards in a turn."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class SideSlip:
    """v_y -> v_y - k v omega."""

    name = "side_slip"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.LATERAL
    order = 150
    parameters = (Parameter("k_s", "s", -2.0, 2.0, 0.05, realistic=0.06),)
    excitation = "circles at two speeds, both ways"
    script = "curves"
    sentence = "in a turn the body slides outwards with {k_s:.3f} s times speed and yaw rate"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Lateral speed per forward speed and half of the yaw rate, (L,)."""
        return (-2.0 * values[:, 0],)


@scalar_function
def term(forward: Any, turn: Any, coefficients: Any) -> Any:
    """Lateral speed of the axle (m/s), or None without the effect."""
    if coefficients is None:
        return None
    (k,) = coefficients
    return k * forward * turn


EFFECT = SideSlip()
