"""Pose offset: the pose sensor sits beside the tracked point."""

from __future__ import annotations

import numpy as np

from disco_hw.effects import Channel, Effect, Mimicked, Parameter, Stage, Symptom, Value, Values, lateral_icr


def plain(x: Value, y: Value, yaw: Value, values: Values) -> tuple[Value, Value, Value]:
    """Return the pose of a sensor that sits beside the tracked point, in the body frame: forward and to the left."""
    forward_m, left_m = values
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return x + (forward_m * cosine - left_m * sine), y + (forward_m * sine + left_m * cosine), yaw


EFFECT = Effect(
    name="pose_offset",
    channel=Channel.POSE_SENSOR,
    stage=Stage.POSE,
    order=10,
    parameters=(Parameter("forward_m", "m", -1.0, 1.0, 0.0), Parameter("left_m", "m", -1.0, 1.0, 0.0, realistic=0.015)),
    plain=plain,
    mimics=Mimicked(lateral_icr, "measure the pose sensor's mount with a ruler, or move the payload and drive again"),
    symptoms=(Symptom.FORWARD_WITH_TURNING,),
    pose_key=("offset", 1.0),
    excitation="turning on the spot, both ways",
    script="spins",
    sentence="the pose sensor sits {forward_m:+.3f} m forward and {left_m:+.3f} m to the left of the tracked point",
)
