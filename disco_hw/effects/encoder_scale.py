"""Encoder scale: the encoders count more or less than the wheels turn."""

from __future__ import annotations

from disco_hw.effects import wheel_gain
from disco_hw.effects.effect import Channel, Effect, Mimicked, Parameter, Stage, Symptom, Value, Values


def plain(left: Value, right: Value, values: Values) -> tuple[Value, Value]:
    """The encoders count (1 + scale) times the wheel's angle, for each side its own."""
    scale_left, scale_right = values
    return left * (1.0 + scale_left), right * (1.0 + scale_right)


EFFECT = Effect(
    name="encoder_scale",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.ENCODERS,
    parameters=(Parameter("left", "1", -0.9, 2.0, 0.0, realistic=0.015), Parameter("right", "1", -0.9, 2.0, 0.0)),
    plain=plain,
    mimics=Mimicked(wheel_gain, "turn each wheel ten times by hand and count ticks"),
    symptoms=(Symptom.TURNS_ON_STRAIGHTS,),
    excitation="straights and turns at several speeds, with poses",
    script="straights",
    sentence="the left encoder counts {left:+.1%} and the right encoder {right:+.1%} from what the wheel turns",
)
