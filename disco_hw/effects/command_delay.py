"""Command delay: the wheels act on what was commanded a while ago."""

from __future__ import annotations

from typing import Any

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class CommandDelay:
    """Pure dead time of a command held constant over each step; a fraction of a step blends two neighbours."""

    name = "command_delay"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.ELSEWHERE
    order = 0
    parameters = (Parameter("delay_s", "s", 0.0, 1.0, 0.05, starts=(0.02, 0.15, 0.3), realistic=0.04),)
    excitation = "steps of the wheel command: start-stops and fast steering"
    script = "starts"
    sentence = "the wheels act on commands {delay_s:.3f} s late"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Whole steps of delay and the fraction on top, each (L,)."""
        steps = np.maximum(values[:, 0], 0.0) / step_s
        whole = np.floor(steps)
        return whole, steps - whole


@scalar_function
def whole_steps(coefficients: Any) -> Any:
    """Number of whole steps of delay."""
    if coefficients is None:
        return 0
    return int(coefficients[0])


@scalar_function
def blend(recent: float, older: float, coefficients: Any) -> Any:
    """Mean command over a step, from the command after the whole steps of delay and the one before it."""
    if coefficients is None:
        return recent
    return recent + coefficients[1] * (older - recent)


EFFECT = CommandDelay()
