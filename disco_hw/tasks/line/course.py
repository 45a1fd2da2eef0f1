"""The line through way-points as a course: its geometry, how far it has been driven, how fast it can be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from disco_hw.tasks.line.table import PathTable
from disco_hw.tasks.task import SLOWEST_M_S, Array, Chassis, Editable, Point

if TYPE_CHECKING:
    from scipy.spatial import KDTree

_PIECE_M = 0.05
_NEAREST = 4
_NO_LENGTH_M2 = 1e-18
_ELSEWHERE_M = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class LineCourse:
    """Straight pieces between way-points (N, 2), N >= 2; a position belongs to the nearest piece.

    `fine_m` (M, 2): the same line in pieces of at most 5 cm; `tree` finds the nearest of these.
    """

    noun: str
    points_m: Array
    fine_m: Array
    tree: KDTree

    @property
    def middle_m(self) -> Point:
        """The middle of the smallest upright rectangle around it."""
        x, y = (0.5 * (self.points_m.min(axis=0) + self.points_m.max(axis=0))).tolist()
        return x, y

    @property
    def reach_m(self) -> float:
        """Half of the longer side of that rectangle."""
        return 0.5 * float(np.ptp(self.points_m, axis=0).max())

    @property
    def length_m(self) -> float:
        """Sum of the pieces."""
        return float(np.hypot(*np.diff(self.points_m, axis=0).T).sum())

    @property
    def start(self) -> tuple[float, float, float]:
        """The first way-point, facing the next that is elsewhere."""
        x, y = self.points_m[0].tolist()
        away = self.points_m - self.points_m[0]
        to_x, to_y = away[int(np.argmax(np.hypot(away[:, 0], away[:, 1]) > _ELSEWHERE_M))].tolist()
        return x, y, math.atan2(to_y, to_x)

    def outline_m(self) -> Array:
        """The way-points."""
        return self.points_m

    def off_m(self, places_m: Array) -> Array:
        """Distance (N,) of positions (N, 2), positive to the right of the nearest piece's direction."""
        begin, step = self.fine_m[:-1], np.diff(self.fine_m, axis=0)
        # What is no number is nowhere, and nothing for the tree to look for.
        known = np.isfinite(places_m).all(axis=1)
        if not known.all():
            found = np.full(len(places_m), np.nan)
            found[known] = self.off_m(places_m[known])
            return found
        # Of the nearest corners the pieces on both sides, as a path may cross itself.
        count = min(_NEAREST, len(self.fine_m))
        corners = self.tree.query(places_m, k=count)[1].reshape(len(places_m), count)
        pieces = np.clip(np.hstack((corners - 1, corners)), 0, len(step) - 1)
        along, offset = step[pieces], places_m[:, None, :] - begin[pieces]
        part = np.clip((offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=2), _NO_LENGTH_M2), 0.0, 1.0)
        away = offset - part[..., None] * along
        distance = np.hypot(away[..., 0], away[..., 1])
        each, nearest = np.arange(len(places_m)), np.argmin(distance, axis=1)
        along, away = along[each, nearest], away[each, nearest]
        return np.asarray(np.copysign(distance[each, nearest], along[:, 1] * away[:, 0] - along[:, 0] * away[:, 1]))


@lru_cache(maxsize=8)
def line_course(points: tuple[Point, ...], noun: str) -> LineCourse:
    """The line through way-points, the same one for the same way-points; `noun` is what it is called."""
    # Loaded for paths alone: half of the daemon's commands need no course at all.
    from scipy.spatial import KDTree  # noqa: PLC0415

    corners = np.array(points, np.float64).reshape(-1, 2)
    at_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    between = np.linspace(0.0, at_m[-1], max(2, math.ceil(at_m[-1] / _PIECE_M) + 1))
    fine_at_m = np.union1d(at_m, between)
    fine = np.column_stack([np.interp(fine_at_m, at_m, column) for column in corners.T])
    return LineCourse(noun, corners, fine, KDTree(fine))


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


def straight_fastest_m_s(robot: Chassis) -> float:
    """Speed straight ahead at which the wheels of the nominal robot are at their limit."""
    return robot.max_wheel_speed_rad_s * robot.wheel_radius_m


def straight_too_fast(speed_m_s: float, robot: Chassis) -> str | None:
    """Why the wheels cannot do a speed straight ahead, and the remedy; None if they can."""
    fastest = straight_fastest_m_s(robot)
    if speed_m_s <= fastest:
        return None
    return (
        f"{speed_m_s:g} m/s asks the wheels for more than {robot.max_wheel_speed_rad_s:g} rad/s; "
        f"at most {math.floor(fastest * 1000.0) / 1000.0:g} m/s"
    )


def speed_range(robot: Chassis) -> Mapping[str, Editable]:
    """The speed as the field that a person may change."""
    return {"speed_m_s": Editable(SLOWEST_M_S, straight_fastest_m_s(robot), "Speed (m/s)")}
