"""Wheel-radius asymmetry: one side's wheels are larger than the other's."""

from __future__ import annotations

from disco_hw.effects import Channel, Effect, Parameter, Stage, Symptom, Value, Values, turning_load
from disco_hw.jit import scalar_function


def plain(wheel_sum: Value, difference: Value, values: Values) -> tuple[Value, Value]:
    """r_R = r (1 + ratio), r_L = r (1 - ratio)."""
    (ratio,) = values
    left, right = (wheel_sum - difference) / 2.0 * (1.0 - ratio), (wheel_sum + difference) / 2.0 * (1.0 + ratio)
    return left + right, right - left


@scalar_function
def term(wheel_sum: float, difference: float, coefficients: tuple[float] | None) -> tuple[float, float]:
    """Sum and difference (right minus left) of the wheel speeds that equal wheels would need (rad/s)."""
    if coefficients is None:
        return wheel_sum, difference
    (ratio,) = coefficients
    return wheel_sum + ratio * difference, difference + ratio * wheel_sum


EFFECT = Effect(
    name="wheel_radius_asymmetry",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.ROLLING,
    order=110,
    parameters=(Parameter("ratio", "1", -0.5, 0.5, 0.0, realistic=0.008),),
    plain=plain,
    term=term,
    may_turn_more=True,
    also_seen_as=(turning_load, "unequal"),
    symptoms=(Symptom.TURNS_ON_STRAIGHTS, Symptom.LEFT_UNLIKE_RIGHT),
    excitation="long straights, forward and back",
    script="straights",
    sentence="the right wheels are {ratio:+.2%} larger than the mean and the left ones as much smaller",
)
