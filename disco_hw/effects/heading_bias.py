"""Heading bias: the measured yaw is off by a constant."""

from __future__ import annotations

from disco_hw.effects import Channel, Effect, Parameter, Stage, Symptom, Value, Values


def plain(x: Value, y: Value, yaw: Value, values: Values) -> tuple[Value, Value, Value]:
    """Return the measured pose, whose yaw is the true one plus this (rad, not wrapped)."""
    (bias_rad,) = values
    return x, y, yaw + bias_rad


EFFECT = Effect(
    name="heading_bias",
    channel=Channel.POSE_SENSOR,
    stage=Stage.POSE,
    order=20,
    parameters=(Parameter("bias_rad", "rad", -3.2, 3.2, 0.0, realistic=0.026),),
    plain=plain,
    symptoms=(Symptom.SIDEWAYS_WITH_SPEED, Symptom.FORWARD_WITH_TURNING),
    pose_key=("yaw_offset_rad", -1.0),
    excitation="straights and fast steering",
    script="curves",
    sentence="the measured yaw is {bias_rad:+.4f} rad off",
)
