"""How far the task has been driven: laps of a circle or of a closed path, the part of an open path that is behind."""

from __future__ import annotations

from typing import Protocol

from disco_hw.config import CircleTask, RobotTask
from disco_hw.control import Path
from disco_hw.daemon.lap_counter import LapCounter

END_M = 0.05
"""The end of an open path is reached so far before it: the planner slows down to nothing there."""


class Progress(Protocol):
    """Follows the robot while the task runs."""

    @property
    def laps(self) -> float:
        """Laps of the present run, or of the last one while paused; of an open path the part that is behind, 0 to 1."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to drive."""

    def add(self, x_m: float, y_m: float) -> None:
        """Take in the position of one tick; the first one after a pause begins anew."""

    def pause(self) -> None:
        """The task does not run in this tick."""


def progress_of(task: RobotTask) -> Progress:
    """The progress of a task that begins."""
    return LapCounter(task) if isinstance(task, CircleTask) else PathProgress(Path.from_config(task))


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

    def add(self, x_m: float, y_m: float) -> None:
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
