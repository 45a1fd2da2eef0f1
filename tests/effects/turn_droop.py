"""An effect between command and wheel that uses the geometry, as another package would bring it along."""

import numpy as np

from disco_hw.effects import Channel, Effect, Parameter, Stage
from disco_hw.jit import cast_like, scalar_function


def plain(left, right, values, geometry):
    """The wheels reach only rate / (1 + k |rate|) of a yaw rate that is asked for."""
    (k_s,), (radius, axial, _) = values, geometry
    rate = radius * (right - left) / axial
    difference = axial / radius * rate / (1.0 + k_s * np.abs(rate))
    mean = (left + right) / 2.0
    return mean - difference / 2.0, mean + difference / 2.0


def coefficients(values, base, step_s):
    """Loss per half of the wheels' difference, (L,)."""
    return (values[:, 0] * 2.0 * base[:, 0] / base[:, 1],)


@scalar_function
def term(left, right, coefficients):
    """Wheel speeds that are aimed for (rad/s)."""
    if coefficients is None:
        return left, right
    (k,) = coefficients
    half = cast_like(0.5, left)
    mean, turning = half * (left + right), half * (right - left)
    turning = turning / (cast_like(1.0, left) + k * abs(turning))
    return mean - turning, mean + turning


EFFECT = Effect(
    name="turn_droop",
    channel=Channel.COMMAND_TO_WHEEL,
    stage=Stage.COMMAND,
    order=35,
    parameters=(Parameter("k_s", "s/rad", 0.0, 5.0, 0.1, realistic=0.05),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    excitation="turning on the spot at two rates",
    script="spins",
    sentence="turning asks for more than the wheels give: {k_s:.3f} of it is lost for every rad/s",
)
