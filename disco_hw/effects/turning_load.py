"""Turning load: scrubbing tyres lower the wheels' speed difference by a constant, however fast the robot turns."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Channel, CommandedDrive, Effect, Parameter, Stage, Value, Values
from disco_hw.jit import cast_like, scalar_function


def plain(left: Value, right: Value, values: Values) -> tuple[Value, Value]:
    """u_L -> u_L + taken, u_R -> u_R - taken; taken = clip(d, -load, load), d half the difference of the rims.

    A servo of stiffness k (N m for each rad/s that a side is too slow) loses load = mu m g L / (8 k) to the Coulomb
    friction of four wheels that are dragged sideways, L their wheelbase and k that of a side's motors together: the
    moment of scrub does not grow with the turn (Wong, Theory of Ground Vehicles, 2008, ch. 6). What the floor holds
    together are the rims: of wheels that are `unequal`, r_R = r (1 + unequal) and r_L = r (1 - unequal), the larger one
    turns more slowly, d = ((1 + unequal) u_R - (1 - unequal) u_L) / 2.
    """
    load, unequal = values
    half = (right - left) / 2.0 + unequal * (left + right) / 2.0
    loss = np.clip(half, -load, load)
    return left + loss, right - loss


@scalar_function
def term(left: float, right: float, coefficients: tuple[float, float] | None) -> tuple[float, float]:
    """Wheel speeds that the load leaves of the commands (rad/s)."""
    if coefficients is None:
        return left, right
    load, unequal = coefficients
    half = cast_like(0.5, left)
    loss = min(max(half * (right - left + unequal * (left + right)), -load), load)
    return left + loss, right - loss


def starts(driven: CommandedDrive) -> tuple[tuple[float, ...], ...]:
    """Return where a fit begins: a part of the turning that was commanded is lost."""
    half = 0.5 * np.abs(driven.commands[:, 1] - driven.commands[:, 0])
    turning = half[half > 0.02 * driven.largest_speed_rad_s]
    return tuple((share * float(np.median(turning)), 0.0) for share in (0.1, 0.4)) if turning.size else ()


EFFECT = Effect(
    name="turning_load",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=45,
    parameters=(
        Parameter("load_rad_s", "rad/s", 0.0, 5.0, 0.3, realistic=0.25),
        Parameter("unequal", "1", -0.2, 0.2, 0.0),
    ),
    plain=plain,
    term=term,
    starts=starts,
    excitation="turning on the spot at two rates, both ways",
    script="spins",
    sentence="turning takes {load_rad_s:.2f} rad/s from each side's wheels, however fast the robot turns",
    other_symptoms=(
        (
            "unequal",
            "as it acts on the two sides, the right wheels are {unequal:+.2%} larger than the mean and the left "
            "ones as much smaller",
        ),
    ),
)
