"""Stiction: a wheel at rest needs a push to start."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Channel, Effect, Parameter, Scan, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function

# Chosen: slower counts as at rest; smaller and a step of the integration may pass over it.
REST_RAD_S = 0.02


def plain(command: Value, speed: Value, values: Values) -> Value:
    """Return the command that acts: a wheel at rest needs |u| above the threshold; a turning one feels nothing."""
    (threshold,) = values
    resting = (np.abs(speed) < 0.02) | (np.asarray(speed * command) < 0.0)
    return np.where(resting & (np.abs(command) <= threshold), 0.0, command)


@scalar_function
def term(command: float, speed: float, coefficients: tuple[float] | None) -> float:
    """Command that moves a wheel that turns with `speed` at the start of the step (rad/s)."""
    if coefficients is None:
        return command
    (threshold,) = coefficients
    # A wheel sent back through zero by a small command stops there.
    resting = (abs(speed) < cast_like(REST_RAD_S, speed)) | (speed * command < cast_like(0.0, speed))
    stuck = resting & (abs(command) <= threshold)
    return cast_like(0.0, command) if stuck else command


EFFECT = Effect(
    name="stiction",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=60,
    parameters=(Parameter("threshold_rad_s", "rad/s", 0.0, 5.0, 0.7, realistic=0.5),),
    plain=plain,
    term=term,
    scan=Scan("threshold_rad_s", lambda _: tuple(np.arange(0.1, 2.05, 0.1).tolist()), 0.002),
    trials=(0.05, 0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0),
    excitation="slow ramps of the wheel command from rest",
    script="ramps",
    sentence="a wheel at rest starts to turn only above {threshold_rad_s:.2f} rad/s",
)
