"""Pose latency: a measured pose is older than its time stamp."""

from __future__ import annotations

from disco_hw.effects import Channel, Effect, Parameter, Stage, Symptom, Value, Values


def plain(time_s: Value, values: Values) -> Value:
    """Return the latency (s): a pose is what was true this long before its time stamp.

    After it, where that is negative.
    """
    (latency_s,) = values
    return time_s - latency_s


EFFECT = Effect(
    name="pose_latency",
    channel=Channel.POSE_SENSOR,
    stage=Stage.POSE_TIME,
    parameters=(Parameter("latency_s", "s", -1.0, 2.0, 0.05, realistic=0.04),),
    plain=plain,
    symptoms=(Symptom.DELAYED_POSITIONS, Symptom.DELAYED_YAW),
    pose_key=("latency_s", 1.0),
    excitation="fast steering and start-stops",
    script="starts",
    sentence="poses are stamped {latency_ms:.0f} ms late",
    sentence_below="poses are stamped {latency_ms:.0f} ms early",
)
