"""Pose latency: a measured pose is older than its time stamp."""

from __future__ import annotations

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage


class PoseLatency:
    """A pose is what was true this long before its time stamp."""

    name = "pose_latency"
    channel = Channel.POSE_SENSOR
    moves = False
    stage = Stage.ELSEWHERE
    order = 0
    parameters = (Parameter("latency_s", "s", -0.5, 2.0, 0.05, starts=(0.0, 0.2), realistic=0.04),)
    excitation = "fast steering and start-stops"
    script = "starts"
    sentence = "poses are {latency_s:.3f} s older than their time stamps"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """None: it moves nothing."""
        return ()


def true_time_s(stamp_s: Array, values: Array) -> Array:
    """When a pose with this time stamp was true; `values` (1,)."""
    return np.asarray(stamp_s - values[0])


EFFECT = PoseLatency()
