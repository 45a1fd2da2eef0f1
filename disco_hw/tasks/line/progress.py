"""How far a line of way-points has been driven: laps of a closed one, the part of any other one that is behind."""

from __future__ import annotations

from disco_hw.tasks.line.table import PathTable

END_M = 0.05
"""The end of an open path is reached so far before it: the planner slows down to nothing there."""


def part_in_words(part: float, length_m: float) -> tuple[str, str]:
    """What is counted along a line and how much of it, for a person."""
    return "progress", f"{part * length_m:.2f} of {length_m:.2f} m ({part:.0%})"


class PathProgress:
    """Progress along a path, by the place nearest to the robot near the one before, as the planner sees it."""

    def __init__(self, path: PathTable) -> None:
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

    def in_words(self) -> tuple[str, str]:
        """Metres, and the part of the whole."""
        return part_in_words(self.laps, self._entries * self._path.spacing_m)

    def add(self, _now_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take in the pose of one tick; the first one after a pause is looked for on the whole path."""
        before = None if self._paused else self._place
        self._place = self._path.place(x_m, y_m, yaw_rad, before)
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
