"""Dead band: the drive subtracts a constant from every command."""

from __future__ import annotations

from typing import Any

from disco_hw.effects.effect import Array, Channel, Parameter, Stage
from disco_hw.jit import scalar_function


class Deadband:
    """u -> sign(u) max(|u| - width, 0) on each wheel's command."""

    name = "deadband"
    channel = Channel.COMMAND_TO_WHEEL
    moves = True
    stage = Stage.COMMAND
    order = 10
    parameters = (Parameter("width_rad_s", "rad/s", 0.0, 5.0, 0.3, starts=(0.1, 0.8), realistic=0.25),)
    excitation = "slow ramps of the wheel command through zero"
    script = "ramps"
    sentence = "the wheels ignore the first {width_rad_s:.2f} rad/s of every command"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """The width, (L,)."""
        return (values[:, 0],)


@scalar_function
def term(command: Any, coefficients: Any) -> Any:
    """Command that is left of a wheel's command (rad/s)."""
    if coefficients is None:
        return command
    (width,) = coefficients
    return command - min(max(command, -width), width)


EFFECT = Deadband()
