"""Stiction: a wheel at rest needs a push to start."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function

REST_RAD_S = 0.02


class Stiction:
    """A wheel at rest, or passing through it, rests until |u| exceeds the threshold; a turning one feels nothing."""

    name = "stiction"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.COMMAND
    order = 60
    parameters = (Parameter("threshold_rad_s", "rad/s", 0.0, 5.0, 0.7, starts=(0.3, 1.2), realistic=0.5),)
    excitation = "slow ramps of the wheel command from rest"
    script = "ramps"
    sentence = "a wheel at rest starts to turn only above {threshold_rad_s:.2f} rad/s"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """The threshold, (L,)."""
        return (values[:, 0],)


@scalar_function
def term(command: Any, speed: Any, coefficients: Any) -> Any:
    """Command that moves a wheel that turns with `speed` at the start of the step (rad/s)."""
    if coefficients is None:
        return command
    (threshold,) = coefficients
    # A wheel sent back through zero by a small command stops there.
    resting = (abs(speed) < cast_like(REST_RAD_S, speed)) | (speed * command < cast_like(0.0, speed))
    stuck = resting & (abs(command) <= threshold)
    return cast_like(0.0, command) if stuck else command


EFFECT = Stiction()
