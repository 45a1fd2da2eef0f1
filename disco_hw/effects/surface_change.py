"""Surface change: from some time on the wheels grip differently."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.effects import Array, Channel, CommandedDrive, Effect, Parameter, Scan, Stage, Symptom, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(forward: Value, turn: Value, time_s: float, values: Values, step_s: float) -> tuple[Value, Value]:
    """Scale the axial distance by (1 + track) and the wheel radius by (1 + radius) from `at_s` on."""
    track, at_s, radius = values
    part = np.clip((time_s + step_s - at_s) / step_s, 0.0, 1.0)
    larger = 1.0 + radius
    return forward * (1.0 + part * (larger - 1.0)), turn * (1.0 + part * (larger / (1.0 + track) - 1.0))


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Change of the forward speed's and of the yaw rate's factor, when, and steps a second; each (L,)."""
    radius = 1.0 + values[:, 2]
    return radius - 1.0, radius / (1.0 + values[:, 0]) - 1.0, values[:, 1], np.full(values.shape[0], 1.0 / step_s)


@scalar_function
def term(
    forward: float, turn: float, time_s: float, coefficients: tuple[float, float, float, float] | None
) -> tuple[float, float]:
    """Forward speed and yaw rate, in a step that begins at `time_s`; the change may fall into the step."""
    if coefficients is None:
        return forward, turn
    forward_change, turn_change, at_s, per_s = coefficients
    one = cast_like(1.0, forward)
    part = min(max((time_s - at_s) * per_s + one, cast_like(0.0, forward)), one)
    return forward * (one + part * forward_change), turn * (one + part * turn_change)


def times(driven: CommandedDrive) -> tuple[float, ...]:
    """Return times to try (s); none in a drive too short to have been two."""
    first, last = driven.first_s, driven.last_s
    if last - first < 30.0:
        return ()
    return tuple(np.arange(first + 10.0, last - 10.0, max(4.0, (last - first) / 40.0)).tolist())


EFFECT = Effect(
    name="surface_change",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.VELOCITY,
    order=120,
    parameters=(
        Parameter("track", "1", -0.8, 3.0, 0.0, realistic=0.06),
        Parameter("time_s", "s", 0.0, 1e5, 60.0, neutral=math.inf),
        # A floor changes how much is lost in turning, and rolling hardly: in a log that only turns both do the same.
        Parameter("radius", "1", -0.8, 3.0, 0.0, expected=0.05),
    ),
    plain=plain,
    coefficients=coefficients,
    term=term,
    may_turn_more=True,
    scan=Scan("time_s", times, 0.25),
    like_a_patch="drive again, later, where it was different",
    symptoms=(Symptom.DISTANCE_CHANGES, Symptom.TURNING_CHANGES),
    excitation="the same turns early and late in the drive",
    script="spins",
    sentence="from {time_s:.1f} s on the axial distance is {track:+.1%} and the wheel radius {radius:+.1%} different",
)
