"""Encoder scale: the encoders count more or less than the wheels turn."""

from __future__ import annotations

from disco_hw.effects import (
    Channel,
    Effect,
    Mimicked,
    Parameter,
    Stage,
    Symptom,
    Value,
    Values,
    wheel_gain,
    wheel_radius_asymmetry,
)


def plain(left: Value, right: Value, values: Values) -> tuple[Value, Value]:
    """Return the encoders' readings: (1 + scale) times the wheel's angle, for each side its own."""
    scale_left, scale_right = values
    return left * (1.0 + scale_left), right * (1.0 + scale_right)


def asymmetry(gains: Values) -> float:
    """Ratio of unequal wheels that poses show: the gain of a wheel's drive is undone between wheel and body."""
    left, right = (float(gain) for gain in gains)
    return (left - right) / (2.0 + left + right)


EFFECT = Effect(
    name="encoder_scale",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.ENCODERS,
    parameters=(Parameter("left", "1", -0.9, 2.0, 0.0, realistic=0.015), Parameter("right", "1", -0.9, 2.0, 0.0)),
    plain=plain,
    mimics=Mimicked(
        wheel_gain,
        "turn each wheel ten times by hand and count ticks",
        seen_too_as=wheel_radius_asymmetry,
        seen_too=asymmetry,
    ),
    symptoms=(Symptom.TURNS_ON_STRAIGHTS,),
    excitation="straights and turns at several speeds, with poses",
    script="straights",
    sentence="relative to the turning of its wheel, the left encoder counts {left:+.1%} and the right encoder "
    "{right:+.1%}",
)
