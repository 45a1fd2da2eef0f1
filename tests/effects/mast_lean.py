"""An effect of the pose sensor that no drive tells from another one, as another package would bring it along."""

from disco_hw.effects import Channel, Effect, Mimicked, Parameter, Stage, lateral_icr


def plain(x, y, yaw, values):
    """The camera's mast leans to the left."""
    (left_m,) = values
    return x, y + left_m, yaw


EFFECT = Effect(
    name="mast_lean",
    channel=Channel.POSE_SENSOR,
    stage=Stage.POSE,
    order=11,
    parameters=(Parameter("left_m", "m", -1.0, 1.0, 0.0, realistic=0.02),),
    plain=plain,
    mimics=Mimicked(lateral_icr, "hold a plumb line to the mast"),
    excitation="turning on the spot, both ways",
    script="spins",
    sentence="the mast leans {left_m:+.3f} m to the left",
)
