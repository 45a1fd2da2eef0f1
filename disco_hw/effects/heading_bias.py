"""Heading bias: the measured yaw is off by a constant."""

from __future__ import annotations

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage


class HeadingBias:
    """The measured yaw is the true one plus this."""

    name = "heading_bias"
    channel = Channel.POSE_SENSOR
    moves = False
    stage = Stage.ELSEWHERE
    order = 0
    parameters = (Parameter("bias_rad", "rad", -3.2, 3.2, 0.0, realistic=0.026),)
    excitation = "straights and fast steering"
    script = "curves"
    sentence = "the measured yaw is {bias_rad:+.4f} rad off"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """None: it moves nothing."""
        return ()


def measured(yaw: Array, values: Array) -> Array:
    """Yaw as the sensor tells it (rad, not wrapped); `values` (1,)."""
    return np.asarray(yaw + values[0])


EFFECT = HeadingBias()
