"""Motor lag: the wheel follows its target as a first-order system."""

from __future__ import annotations

from typing import Any

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class MotorLag:
    """Wheel speed w' = (target - w) / tau, solved exactly over a step of constant target."""

    name = "motor_lag"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.RESPONSE
    order = 70
    parameters = (Parameter("tau_s", "s", 0.0, 2.0, 0.1, starts=(0.03, 0.3), realistic=0.05),)
    excitation = "steps of the wheel command: start-stops and fast steering"
    script = "starts"
    sentence = "the wheels follow their command with a time constant of {tau_s:.3f} s"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """What of the initial error is left at the end of a step, and in the mean over it; each (L,)."""
        tau_s = np.maximum(values[:, 0], 1e-9)
        left_at_end = np.exp(-step_s / tau_s)
        return left_at_end, (1.0 - left_at_end) * tau_s / step_s


@scalar_function
def term(command: float, speed: float, coefficients: Any) -> Any:
    """Wheel speed at the end of the step and its mean over the step (rad/s)."""
    if coefficients is None:
        return command, command
    left_at_end, left_in_mean = coefficients
    error = speed - command
    return command + error * left_at_end, command + error * left_in_mean


EFFECT = MotorLag()
