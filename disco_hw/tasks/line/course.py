"""The line through way-points as a course: pure geometry for panels and pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from disco_hw.tasks.task import Array, Point

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
