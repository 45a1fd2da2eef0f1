"""Turning load: the scrub of the tyres takes a constant from the wheels' difference, however fast the robot turns."""

from __future__ import annotations

import numpy as np

from disco_hw.effects.effect import Array, Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(left: Value, right: Value, values: Values) -> tuple[Value, Value]:
    """d = (u_R - u_L) / 2 -> sign(d) max(|d| - load, 0); the mean of the wheel speeds is kept.

    A servo of stiffness k (N m for each rad/s that a side is too slow) loses load = mu m g L / (8 k) to the Coulomb
    friction of four wheels that are dragged sideways, L their wheelbase and k that of a side's motors together: the
    moment of scrub does not grow with the turn (Wong, Theory of Ground Vehicles, 2008, ch. 6).
    """
    (load,) = values
    mean, half = (left + right) / 2.0, (right - left) / 2.0
    half = np.sign(half) * np.maximum(np.abs(half) - load, 0.0)
    return mean - half, mean + half


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """The load, (L,)."""
    return (values[:, 0],)


@scalar_function
def term(left: float, right: float, coefficients: tuple[float] | None) -> tuple[float, float]:
    """Wheel speeds that the load leaves of the commands (rad/s)."""
    if coefficients is None:
        return left, right
    (load,) = coefficients
    half = cast_like(0.5, left)
    mean, difference = half * (left + right), half * (right - left)
    difference -= min(max(difference, -load), load)
    return mean - difference, mean + difference


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """A fit begins where a part of the turning that was commanded is lost."""
    half = 0.5 * np.abs(driven.commands[:, 1] - driven.commands[:, 0])
    turning = half[half > 0.02 * driven.largest_speed_rad_s]
    return tuple((share * float(np.median(turning)),) for share in (0.1, 0.4)) if turning.size else ()


EFFECT = Effect(
    name="turning_load",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=45,
    parameters=(Parameter("load_rad_s", "rad/s", 0.0, 5.0, 0.3, realistic=0.25),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    starts=starts,
    excitation="turning on the spot at two rates, both ways",
    script="spins",
    sentence="turning takes {load_rad_s:.2f} rad/s from each side's wheels, however fast the robot turns",
)
