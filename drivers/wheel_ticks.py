"""Cumulative wheel angles from encoder counters that wrap."""

from __future__ import annotations

import math

TICKS_MODULUS = 1 << 24
SPEED_MARGIN = 1.5
SLACK_TICKS = 4.0
REANCHOR_AFTER = 5


class WheelTicks:
    """Turns a pair of 24-bit tick counters into angles (rad, left and right) that do not wrap.

    Two readings differ by the shortest way round the ring, and by no more than the wheels can turn in the time between:
    one and a half times `max_speed_rad_s`, and a few ticks. What is more is implausible and dropped; after five such
    readings in a row the counters are taken as they are, with no motion in between. The first reading is `start`.
    """

    __slots__ = (
        "_angle_per_tick",
        "_left",
        "_max_ticks_per_us",
        "_rejected",
        "_right",
        "_start",
        "_t_us",
        "_ticks_left",
        "_ticks_right",
    )

    def __init__(self, ticks_per_rev: int, max_speed_rad_s: float, start: tuple[float, float] = (0.0, 0.0)) -> None:
        self._start = start
        self._angle_per_tick = 2.0 * math.pi / ticks_per_rev
        self._max_ticks_per_us = SPEED_MARGIN * max_speed_rad_s / self._angle_per_tick * 1e-6
        self._left = 0
        self._right = 0
        self._rejected = 0
        self._ticks_left: int | None = None
        self._ticks_right = 0
        self._t_us = 0

    def forget(self) -> None:
        """Take the next reading as it is: the angles go on from where they are."""
        self._ticks_left = None

    def update(self, ticks_left: int, ticks_right: int, t_us: int) -> tuple[float, float] | None:
        """Take in a reading of device time `t_us` (which does not wrap); return both angles, None if implausible."""
        if self._ticks_left is not None:
            left = _shortest(ticks_left - self._ticks_left)
            right = _shortest(ticks_right - self._ticks_right)
            limit = min(self._max_ticks_per_us * (t_us - self._t_us) + SLACK_TICKS, TICKS_MODULUS // 2 - 1)
            if max(abs(left), abs(right)) <= limit:
                self._left += left
                self._right += right
            else:
                self._rejected += 1
                if self._rejected < REANCHOR_AFTER:
                    return None
        self._rejected = 0
        self._ticks_left, self._ticks_right, self._t_us = ticks_left, ticks_right, t_us
        return self.angles

    @property
    def angles(self) -> tuple[float, float]:
        """Both angles after the last accepted reading."""
        left, right = self._start
        return left + self._left * self._angle_per_tick, right + self._right * self._angle_per_tick


def _shortest(difference: int) -> int:
    half = TICKS_MODULUS // 2
    return (difference + half) % TICKS_MODULUS - half
