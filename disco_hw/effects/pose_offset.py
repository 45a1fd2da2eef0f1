"""Pose offset: the pose sensor sits beside the tracked point."""

from __future__ import annotations

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage


class PoseOffset:
    """The sensor sits beside the tracked point, in the body frame: forward and to the left."""

    name = "pose_offset"
    channel = Channel.POSE_SENSOR
    moves = False
    stage = Stage.ELSEWHERE
    order = 0
    parameters = (
        Parameter("forward_m", "m", -1.0, 1.0, 0.0),
        Parameter("left_m", "m", -1.0, 1.0, 0.0, realistic=0.015),
    )
    excitation = "turning on the spot, both ways"
    script = "spins"
    sentence = "the pose sensor sits {forward_m:+.3f} m forward and {left_m:+.3f} m to the left of the tracked point"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """None: it moves nothing."""
        return ()


def measured(x: Array, y: Array, yaw: Array, values: Array) -> tuple[Array, Array]:
    """Position of the sensor; `values` (2,)."""
    cos_yaw, sin_yaw = np.cos(yaw), np.sin(yaw)
    return x + values[0] * cos_yaw - values[1] * sin_yaw, y + values[0] * sin_yaw + values[1] * cos_yaw


EFFECT = PoseOffset()
