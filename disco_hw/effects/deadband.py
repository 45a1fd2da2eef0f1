"""Dead band: the drive subtracts a constant from every command."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Channel, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import scalar_function


def plain(command: Value, values: Values) -> Value:
    """Map u to sign(u) max(|u| - width, 0) on each wheel's command."""
    (width,) = values
    return np.sign(command) * np.maximum(np.abs(command) - width, 0.0)


@scalar_function
def term(command: float, coefficients: tuple[float] | None) -> float:
    """Command that is left of a wheel's command (rad/s)."""
    if coefficients is None:
        return command
    (width,) = coefficients
    return command - min(max(command, -width), width)


EFFECT = Effect(
    name="deadband",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=10,
    parameters=(Parameter("width_rad_s", "rad/s", 0.0, 5.0, 0.3, realistic=0.25),),
    plain=plain,
    term=term,
    starts=lambda _: ((0.2,),),
    dead_by="width_rad_s",
    excitation="slow ramps of the wheel command through zero",
    script="ramps",
    sentence="the wheels ignore the first {width_rad_s:.2f} rad/s of every command",
)
