"""Downhill slide: tyres that slip sideways in a turn give way to the pull of a slope; rolling straight they hold."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Array, Channel, Effect, Parameter, Stage, Symptom, Value, Values
from disco_hw.jit import scalar_function


def plain(
    x: Value, y: Value, wheel_sum: Value, difference: Value, values: Values, geometry: Values, step_s: float
) -> tuple[Value, Value]:
    """Return a drift in the world frame in proportion to how fast the wheels say that the robot turns.

    Dry friction acts against the direction in which a tyre is dragged, whole. A pull from aside then meets no
    resistance until the tyre moves with it: by the pull over the friction times the speed of the drag, which grows with
    the yaw rate (Coulomb's law; Wong, Theory of Ground Vehicles, 2008, ch. 6).
    """
    (slide_x_m, slide_y_m), (radius, axial, _) = values, geometry
    turned = radius / axial * np.abs(difference) * step_s
    return x + slide_x_m * turned, y + slide_y_m * turned


def coefficients(values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
    """Slide in a step along x and y for each rad/s of the wheels' difference (m s/rad), (L,) each."""
    turned = base[:, 0] / base[:, 1] * step_s
    return values[:, 0] * turned, values[:, 1] * turned


@scalar_function
def term(x: float, y: float, difference: float, coefficients: tuple[float, float] | None) -> tuple[float, float]:
    """Position (m) after a step's slide; of the difference of the wheel speeds (rad/s)."""
    if coefficients is None:
        return x, y
    slide_x, slide_y = coefficients
    return x + slide_x * abs(difference), y + slide_y * abs(difference)


EFFECT = Effect(
    name="downhill_slide",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.WORLD,
    order=175,
    parameters=(
        Parameter("slide_x_m", "m/rad", -2.0, 2.0, 0.0, realistic=0.05),
        Parameter("slide_y_m", "m/rad", -2.0, 2.0, 0.0),
    ),
    plain=plain,
    coefficients=coefficients,
    term=term,
    uses_geometry=True,
    symptoms=(Symptom.DOWNHILL,),
    excitation="turns in all directions, and straights",
    script="spins",
    sentence="a turning robot slides by ({slide_x_m:+.3f}, {slide_y_m:+.3f}) m in the world frame for each radian",
)
