"""Command delay: the wheels act on a command after a dead time."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(values: Values) -> Value:
    """Return the age (s) of the command in force: pure dead time of a command held constant over each step."""
    (delay_s,) = values
    return delay_s


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Whole steps of delay and the fraction on top, each (L,)."""
    steps = np.maximum(values[:, 0], 0.0) / step_s
    steps_floor = np.floor(steps)
    return steps_floor, steps - steps_floor


@scalar_function
def term(recent: float, older: float, coefficients: tuple[float, float] | None) -> float:
    """Mean command over a step, from the command after the whole steps of delay and the one before it."""
    if coefficients is None:
        return recent
    return recent + coefficients[1] * (older - recent)


EFFECT = Effect(
    name="command_delay",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.DELAY,
    # A host that stamps commands or encoders late shows as a negative delay; better reported than hidden in noise.
    parameters=(Parameter("delay_s", "s", 0.0, 1.0, 0.05, realistic=0.04, least_fitted=-1.0),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    delayed_by="delay_s",
    delay_starts=(0.02, 0.1, 0.3, -0.25),
    starts=lambda _: ((0.03,), (0.12,), (0.3,), (-0.1,), (-0.3,)),
    symptoms=(Symptom.DELAYED_YAW,),
    excitation="steps of the wheel command: start-stops and fast steering",
    script="starts",
    sentence="the wheels act on commands {delay_ms:.0f} ms late",
    sentence_below="the wheels act on commands {delay_ms:.0f} ms before they come: a clock stamps too late",
)
