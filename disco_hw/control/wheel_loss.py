"""How much slower wheels turn than their commands and the model say: an observer with an integral, for either wheel.

A dead band, a motor's gain or a battery that the model has wrong lose a part of every command. The wheels' speeds as
the model makes them of the commands are followed, corrected by the measured ones; the loss is the integral of what
that corrects (a Luenberger observer of a constant disturbance at the input). It goes with the command's sign, so that
it stays when a wheel turns back.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.plan import PlannerState

Array = NDArray[np.float64]
Wheels = tuple[float, float]

CORRECTED_S, FOLLOWED_S = 0.3, 0.5
"""Time constants of the speeds and of the loss."""
LARGEST_RAD_S = 0.6
WHOLE_RAD_S = 1.0
"""A command of this size loses all of it, a smaller one in proportion, so that one of zero stays zero."""
LONGEST_GAP_S = 0.2


class WheelLoss:
    """What either wheel loses of its command (rad/s); negative where it turns faster than the model says."""

    def __init__(self) -> None:
        self._loss = np.zeros(2)
        self._speeds: Wheels | None = None
        self._last_ns = 0

    @property
    def rad_s(self) -> Wheels:
        """Left and right."""
        left, right = self._loss.tolist()
        return left, right

    @property
    def is_none(self) -> bool:
        """Whether nothing was lost so far."""
        return not self._loss.any()

    def pause(self) -> None:
        """Something else moves the robot for a while; what is known of its wheels stays."""
        self._speeds = None

    def step(
        self, now_ns: int, state: PlannerState, after: Callable[[Wheels, float, PlannerState], Wheels]
    ) -> None:  # fmt: skip
        """Compare the measured speeds with what `after(speeds, seconds, state)` says they are by now."""
        before, gap_s = self._speeds, (now_ns - self._last_ns) * 1e-9
        measured = state.left_speed_rad_s, state.right_speed_rad_s
        self._last_ns, self._speeds = now_ns, measured
        if before is None or not 0.0 < gap_s < LONGEST_GAP_S or not state.sent:
            return
        expected, last = np.array(after(before, gap_s, state)), state.sent[-1]
        missing = expected - measured
        if not np.isfinite(missing).all():
            return
        sign = np.clip(np.array((last.left_rad_s, last.right_rad_s)) / WHOLE_RAD_S, -1.0, 1.0)
        self._loss = np.clip(self._loss + gap_s / FOLLOWED_S * sign * missing, -LARGEST_RAD_S, LARGEST_RAD_S)
        left, right = (expected - min(gap_s / CORRECTED_S, 1.0) * missing).tolist()
        self._speeds = left, right

    def acting(self, commands: Array) -> Array:
        """Commands (N, 2) to a robot that loses nothing and turns as this one does with these."""
        return commands - self._loss * np.clip(commands / WHOLE_RAD_S, -1.0, 1.0)

    def asked(self, commands: Array) -> Array:
        """The inverse of `acting`."""
        small = commands / (1.0 - self._loss / WHOLE_RAD_S)
        large = commands + np.sign(commands) * self._loss
        return np.where(np.abs(small) < WHOLE_RAD_S, small, large)
