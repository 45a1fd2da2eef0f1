"""Surface change: from some time on the wheels grip differently."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function


class SurfaceChange:
    """From `time_s` on the axial distance is (1 + track) and the wheel radius (1 + radius) times the old."""

    name = "surface_change"
    channel = Channel.WHEEL_TO_BODY
    moves = True
    stage = Stage.VELOCITY
    order = 120
    parameters = (
        Parameter("track", "1", -0.8, 3.0, 0.0, realistic=0.06),
        Parameter("time_s", "s", 0.0, 1e5, 60.0, neutral=math.inf),
        Parameter("radius", "1", -0.8, 3.0, 0.0),
    )
    excitation = "the same turns early and late in the drive"
    script = "spins"
    sentence = "from {time_s:.1f} s on the axial distance is {track:+.1%} and the wheel radius {radius:+.1%} different"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """Change of the forward speed's and of the yaw rate's factor, when, and steps a second; each (L,)."""
        radius = 1.0 + values[:, 2]
        return radius - 1.0, radius / (1.0 + values[:, 0]) - 1.0, values[:, 1], np.full(values.shape[0], 1.0 / step_s)


@scalar_function
def term(forward: Any, turn: Any, time_s: Any, coefficients: Any) -> Any:
    """Forward speed and yaw rate, in a step that begins at `time_s`; the change may fall into the step."""
    if coefficients is None:
        return forward, turn
    forward_change, turn_change, at_s, per_s = coefficients
    one = cast_like(1.0, forward)
    part = min(max((time_s - at_s) * per_s + one, cast_like(0.0, forward)), one)
    return forward * (one + part * forward_change), turn * (one + part * turn_change)


EFFECT = SurfaceChange()
