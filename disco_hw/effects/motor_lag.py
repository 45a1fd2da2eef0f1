"""Motor lag: the wheel follows its target as a first-order system."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(end: Value, mean: Value, speed: Value, values: Values, step_s: float) -> tuple[Value, Value]:
    """Wheel speed w' = (target - w) / tau, solved exactly over a step of constant target: at its end, and its mean."""
    target, tau_s = end, np.maximum(values[0], 1e-9)
    left_at_end = np.exp(-step_s / tau_s)
    left_in_mean = (1.0 - left_at_end) * tau_s / step_s
    return target + (speed - target) * left_at_end, target + (speed - target) * left_in_mean


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Return the share of the initial error left at the end of a step, and in the mean over it; each (L,)."""
    tau_s = np.maximum(values[:, 0], 1e-9)
    left_at_end = np.exp(-step_s / tau_s)
    return left_at_end, (1.0 - left_at_end) * tau_s / step_s


@scalar_function
def term(end: float, mean: float, speed: float, coefficients: tuple[float, float] | None) -> tuple[float, float]:
    """Wheel speed at the end of the step and its mean over the step (rad/s)."""
    if coefficients is None:
        return end, mean
    left_at_end, left_in_mean = coefficients
    error = speed - end
    return end + error * left_at_end, end + error * left_in_mean


EFFECT = Effect(
    name="motor_lag",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.RESPONSE,
    order=70,
    parameters=(Parameter("tau_s", "s", 0.0, 2.0, 0.1, realistic=0.05),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    delayed_by="tau_s",
    delay_starts=(0.02, 0.15, 0.4, 0.02),
    starts=lambda _: ((0.05,), (0.25,)),
    symptoms=(Symptom.DELAYED_YAW,),
    excitation="steps of the wheel command: start-stops and fast steering",
    script="starts",
    sentence="the wheels follow their command slowly, with a time constant of {tau_ms:.0f} ms",
)
