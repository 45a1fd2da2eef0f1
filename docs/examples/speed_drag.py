"""Speed drag: the faster the robot drives, the more of its speed is lost."""

from disco_hw.effects import Channel, Effect, Parameter, Stage, Symptom
from disco_hw.jit import scalar_function


def plain(forward, values):
    """Return the speed that is left: v - k v^3."""
    (k,) = values
    return forward - k * forward**3


def coefficients(values, base, step_s):
    """k, (L,)."""
    return (values[:, 0],)


@scalar_function
def term(forward, coefficients):
    """Forward speed that is left (m/s)."""
    if coefficients is None:
        return forward
    (k,) = coefficients
    return forward - k * forward * forward * forward


EFFECT = Effect(
    name="speed_drag",
    channel=Channel.WHEEL_TO_BODY,
    stage=Stage.FORWARD,
    order=145,
    parameters=(Parameter("k_s2_m2", "s^2/m^2", -5.0, 5.0, 0.3, realistic=0.2),),
    plain=plain,
    coefficients=coefficients,
    term=term,
    symptoms=(Symptom.SHORTER_AT_SPEED,),
    excitation="straights at two speeds",
    script="straights",
    sentence="drag takes {k_s2_m2:.2f} v^3 of the speed",
)
