"""How far the task has been driven: laps of a circle or of a closed path, the part of any other path that is behind."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from disco_hw.config import CircleTask, PathTask, RobotTask, TimedPathTask
from disco_hw.control import Path


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


END_M = 0.05
"""The end of an open path is reached so far before it: the planner slows down to nothing there."""


class Progress(Protocol):
    """Follows the robot while the task runs."""

    @property
    def laps(self) -> float:
        """Laps of the present run, or of the last one while paused; of a path with an end the part behind, 0 to 1."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to drive."""

    def add(self, now_ns: int, x_m: float, y_m: float) -> None:
        """Take in the position of one tick; the first one after a pause begins anew."""

    def pause(self) -> None:
        """The task does not run in this tick."""


def progress_of(task: RobotTask) -> Progress:
    """The progress of a task that begins."""
    match task:
        case CircleTask():
            return LapCounter(task)
        case PathTask():
            return PathProgress(Path.from_config(task))
        case _:
            return TimedProgress(task)


class PathProgress:
    """Progress along a path, by the place nearest to the robot near the one before, as the planner sees it."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries = len(path.table) - 1
        self._place: float | None = None
        self._moved = 0.0
        self._paused = True

    @property
    def laps(self) -> float:
        """Laps of a closed path since the task started, or the part of an open one that is behind, 0 to 1."""
        if self._path.closed:
            return self._moved / self._entries
        return (self._place or 0.0) / self._entries

    @property
    def finished(self) -> bool:
        """Whether the end of an open path is reached."""
        if self._path.closed or self._place is None or self._paused:
            return False
        return (self._entries - self._place) * self._path.spacing_m <= END_M

    def add(self, _now_ns: int, x_m: float, y_m: float) -> None:
        """Take in the position of one tick; the first one after a pause is looked for on the whole path."""
        before = None if self._paused else self._place
        self._place = self._path.place(x_m, y_m, before)
        if before is None:
            self._moved, self._paused = 0.0, False
            return
        step = self._place - before
        if self._path.closed:
            step -= self._entries * round(step / self._entries)
        self._moved += step

    def pause(self) -> None:
        """The task does not run in this tick."""
        self._paused = True


class TimedProgress:
    """Progress along way-points by time: the part of the way that is due, and whether the last way-point is reached."""

    def __init__(self, task: TimedPathTask) -> None:
        places = np.array(task.points)
        behind_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
        self._times_s, self._parts = np.array(task.times_s), behind_m / behind_m[-1]
        self._end_m = task.points[-1]
        self._begun_ns: int | None = None
        self._elapsed_s, self._off_m = 0.0, math.inf

    @property
    def laps(self) -> float:
        """The part of the way that should be behind, 0 to 1, of the present run or of the last one while paused."""
        return float(np.interp(self._elapsed_s, self._times_s, self._parts))

    @property
    def finished(self) -> bool:
        """Whether the last time is over and the robot is at the last way-point."""
        return self._begun_ns is not None and self._elapsed_s >= self._times_s[-1] and self._off_m <= END_M

    def add(self, now_ns: int, x_m: float, y_m: float) -> None:
        """Take in the position of one tick; the first one after a pause is the start, from which the times count."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
        self._elapsed_s = (now_ns - self._begun_ns) * 1e-9
        self._off_m = math.dist((x_m, y_m), self._end_m)

    def pause(self) -> None:
        """The task does not run in this tick."""
        self._begun_ns = None
