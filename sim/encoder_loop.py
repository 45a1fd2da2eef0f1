"""Motor loops of vendors' controllers with an encoder that does not report what its motor does.

With a sound encoder the plant's own speed loop stands for the controller's, and nothing here acts. With a wrong one
the wanted speed less the reported one drives a proportional-integral term that ends at full speed, as a RoboClaw's
does when the encoder's cable comes off. A motor that is commutated by the encoder cannot run away so: its field
stands where the encoder says, and the rotor locks to it.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from firmware_protocol.firmware_core import FirmwareInputs

# Chosen: larger runs away sooner when the encoder does not count.
PROPORTIONAL = 1.5
INTEGRAL_PER_S = 12.0
LOCKED_RAD = 0.05
"""Of the wheel: a quarter of an electrical turn is less on every motor with a gear or more than seven pole pairs."""


class EncoderUse(enum.Enum):
    """Uses that a controller makes of the encoder that it reports."""

    SPEED = "it regulates the speed of a brushed motor by it"
    COMMUTATION = "it turns the field of a brushless motor by it"


@dataclass(slots=True)
class EncoderLoop:
    """The loops of both sides; `full_rad_s`: wheel speed at full duty."""

    use: EncoderUse
    full_rad_s: float
    _error_rad_s: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _error_rad: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _denied_rad: list[float] = field(default_factory=lambda: [0.0, 0.0])

    def see(
        self, setpoints_rad_s: Sequence[float], true: FirmwareInputs, reported: FirmwareInputs, dt_s: float,
        regulates: bool,
    ) -> None:  # fmt: skip
        """Take in what was wanted, what the encoders saw, and what the controller was told of it."""
        seen = (true.left_speed_rad_s, true.right_speed_rad_s)
        measured = (reported.left_speed_rad_s, reported.right_speed_rad_s)
        for side in (0, 1):
            denied = seen[side] - measured[side]
            # A field whose angle was lost finds it again only when it is aligned anew.
            self._denied_rad[side] = self._denied_rad[side] + denied * dt_s if regulates else 0.0
            if not regulates or denied == 0.0:
                # A loop that is let go, or that sees its motor again, forgets.
                self._error_rad_s[side] = self._error_rad[side] = 0.0
                continue
            self._error_rad_s[side] = setpoints_rad_s[side] - measured[side]
            self._error_rad[side] += self._error_rad_s[side] * dt_s

    def drive(self, setpoints_rad_s: Sequence[float]) -> tuple[float, float]:
        """Return the speeds that the motors are driven at while the loop holds the wanted ones."""
        left, right = (self._drive(side, setpoint) for side, setpoint in enumerate(setpoints_rad_s))
        return left, right

    def _drive(self, side: int, setpoint: float) -> float:
        if self.use is EncoderUse.COMMUTATION:
            return 0.0 if abs(self._denied_rad[side]) > LOCKED_RAD else setpoint
        driven = setpoint + PROPORTIONAL * self._error_rad_s[side] + INTEGRAL_PER_S * self._error_rad[side]
        return math.copysign(min(abs(driven), max(self.full_rad_s, abs(setpoint))), driven)
