"""Battery sag: wheel speed falls as the battery empties."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function

# The time over which the effect's value says what is lost; chosen: a usual drive.
REFERENCE_S = 150.0
LARGEST_LOSS = 0.3
"""A pack is empty before its voltage has fallen further: a lithium cell from 4.2 V to 3.0 V."""


def plain(left: Value, right: Value, time_s: float, values: Values) -> tuple[Value, Value]:
    """Map u to u (1 - loss t / 150 s): wheel speed falls linearly with the time since the start, to 70 % at least."""
    (loss,) = values
    kept = 1.0 - np.clip(loss * time_s / 150.0, 0.0, 0.3)
    return left * kept, right * kept


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Loss per second, (L,)."""
    return (values[:, 0] / REFERENCE_S,)


@scalar_function
def term(left: float, right: float, time_s: float, coefficients: tuple[float] | None) -> tuple[float, float]:
    """Wheel speeds that are left at this time (rad/s)."""
    if coefficients is None:
        return left, right
    (loss_per_s,) = coefficients
    loss = min(max(loss_per_s * time_s, cast_like(0.0, time_s)), cast_like(LARGEST_LOSS, time_s))
    return left - left * loss, right - right * loss


EFFECT = Effect(
    name="battery_sag",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=50,
    parameters=(Parameter("loss", "1 in 150 s", 0.0, 0.9, 0.05, realistic=0.05),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    excitation="the same manoeuvre early and late in a drive of minutes",
    script="straights",
    sentence="the wheels lose {loss:.1%} of their speed in every 150 s of driving",
)
