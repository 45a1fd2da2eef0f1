"""Observer of the wheel speed that is lost against the commands and the model, with an integral of the difference.

A dead band, a motor's gain or a battery that the model has wrong lose a part of either wheel's command. Wheels that
scrub over the floor while the robot turns lose a part of the difference between them: the outer one turns slower, the
inner one faster, and one that is asked to stand is dragged along. The wheels' speeds as the model makes them of the
commands are followed, corrected by the measured ones; the losses are the integral of what that corrects (a Luenberger
observer of constant disturbances at the input), shared out between the three in proportion to what they act. Each goes
with the sign of what it is a loss of, so that it stays when a wheel or the robot turns the other way.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.plan import PlannerState

Array = NDArray[np.float64]
Wheels = tuple[float, float]

CORRECTED_S, FOLLOWED_S = 0.3, 0.5
"""Time constants of the speeds and of the losses."""
# Chosen: a limit, so that a wheel that does not turn at all is not made up for.
LARGEST_RAD_S = 0.6
FULL_RAD_S = 1.0
"""A command, or half a difference, of this size loses all of it, a smaller one in proportion, so that one of zero stays
zero."""
# Chosen: over longer gaps nothing can be said of what was expected.
LONGEST_GAP_S = 0.2


class WheelLoss:
    """Estimated loss of a command (rad/s) at each wheel and in half their difference; negative where they gain.

    `rad_s` (2,): of the left wheel and of the right one; `turn_rad_s`: of half the difference between the two.
    """

    def __init__(self) -> None:
        self.rad_s: Array = np.zeros(2)
        self.turn_rad_s = 0.0
        self._speeds: Wheels | None = None
        self._last_ns = 0

    @property
    def is_none(self) -> bool:
        """Whether nothing was lost so far."""
        return self.turn_rad_s == 0.0 and not self.rad_s.any()

    def pause(self) -> None:
        """Interrupt the observer while something else moves the robot; what is known of its wheels stays."""
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
        # Missing is sign * loss of a wheel, and `turns` * turn more on the right one and less on the left one.
        sides = np.array([last.left_rad_s, last.right_rad_s])
        turns = float(_part(0.5 * (sides[1] - sides[0])))
        sign = _part(_turned(sides, self.turn_rad_s, _reduced))
        share = turns * turns / (1.0 + 2.0 * turns * turns)
        apart = float(missing[1] - missing[0])
        loss_by_wheel = missing + share * apart * _OUTWARDS
        follow = gap_s / FOLLOWED_S
        self.rad_s = np.clip(self.rad_s + follow * sign * loss_by_wheel, -LARGEST_RAD_S, LARGEST_RAD_S)
        turn = self.turn_rad_s + follow * turns * float(loss_by_wheel[1] - loss_by_wheel[0])
        self.turn_rad_s = min(max(turn, -LARGEST_RAD_S), LARGEST_RAD_S)
        left, right = (expected - min(gap_s / CORRECTED_S, 1.0) * missing).tolist()
        self._speeds = left, right

    def acting(self, commands: Array) -> Array:
        """Commands (N, 2) to a robot that loses nothing and turns as this one does with these."""
        return _reduced(_turned(commands, self.turn_rad_s, _reduced), self.rad_s)

    def commanded(self, commands: Array) -> Array:
        """Return the inverse of `acting`."""
        return _turned(_greater(commands, self.rad_s), self.turn_rad_s, _greater)


_OUTWARDS = np.array([1.0, -1.0])


def _part(commands: Array) -> Array:
    """Return the signed part of its loss that each command has: proportional when slow, then -1 or 1."""
    return np.clip(commands / FULL_RAD_S, -1.0, 1.0)


def _reduced(commands: Array, loss: Array | float) -> Array:
    return commands - loss * _part(commands)


def _greater(commands: Array, loss: Array | float) -> Array:
    """Return the inverse of `_reduced`."""
    small = commands / (1.0 - loss / FULL_RAD_S)
    large = commands + np.sign(commands) * loss
    return np.where(np.abs(small) < FULL_RAD_S, small, large)


def _turned(commands: Array, turn: float, change: Callable[[Array, float], Array]) -> Array:
    """Commands (..., 2) of which half the difference between left and right is changed."""
    half = 0.5 * (commands[..., 1] - commands[..., 0])
    more = (change(half, turn) - half)[..., None]
    turned: Array = commands - more * _OUTWARDS
    return turned
