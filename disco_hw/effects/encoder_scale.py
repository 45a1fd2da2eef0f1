"""Encoder scale: the encoders count more or less than the wheels turn."""

from __future__ import annotations

from disco_hw.effects.effect import Array, Channel, Parameter, Stage


class EncoderScale:
    """The encoders count (1 + scale) times the wheel's angle, for each side its own."""

    name = "encoder_scale"
    channel = Channel.WHEEL_TO_BODY
    moves = False
    stage = Stage.ELSEWHERE
    order = 0
    parameters = (Parameter("left", "1", -0.9, 2.0, 0.0, realistic=0.015), Parameter("right", "1", -0.9, 2.0, 0.0))
    excitation = "straights and turns at several speeds, with poses"
    script = "straights"
    sentence = "the left encoder counts {left:+.1%} and the right encoder {right:+.1%} from what the wheel turns"

    def coefficients(self, values: Array, base: Array, step_s: float) -> tuple[Array, ...]:
        """None: it moves nothing."""
        return ()


def measured(left: Array, right: Array, values: Array) -> tuple[Array, Array]:
    """Wheel angles or speeds as the encoders tell them; `values` (2,)."""
    return left * (1.0 + values[0]), right * (1.0 + values[1])


EFFECT = EncoderScale()
