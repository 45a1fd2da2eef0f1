"""Counts laps around the circle's centre while the task runs."""

from __future__ import annotations

import math

from disco_hw.config import CircleTask


class LapCounter:
    """Laps since the task last started, counter-clockwise positive."""

    def __init__(self, task: CircleTask) -> None:
        self._task = task
        self._last_rad: float | None = None
        self._turned_rad = 0.0
        self._paused = True

    @property
    def laps(self) -> float:
        """Laps of the present run, or of the last one while paused."""
        return self._turned_rad / (2.0 * math.pi)

    @property
    def finished(self) -> bool:
        """Never: a circle has no end."""
        return False

    def add(self, _now_ns: int, x_m: float, y_m: float) -> None:
        """Take in the position of one tick; the first one after a pause starts a new count."""
        angle = math.atan2(y_m - self._task.center_y_m, x_m - self._task.center_x_m)
        if self._paused or self._last_rad is None:
            self._turned_rad, self._paused = 0.0, False
        else:
            self._turned_rad += math.remainder(angle - self._last_rad, 2.0 * math.pi)
        self._last_rad = angle

    def pause(self) -> None:
        """The task does not run in this tick."""
        self._paused = True
