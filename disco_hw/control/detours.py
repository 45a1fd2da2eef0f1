"""Around which obstacles on the task's line a plan leads, on which side, and how far.

A detour moves the line aside, smoothly, as a bump whose middle passes the obstacle. Rollouts keep to the moved line, as
the task sees each of them where the bump takes it back to (`kernel/avoid.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel.avoid import DETOUR_COLUMNS, DETOURS
from disco_hw.fence import Footprint
from disco_hw.fence.clearance import Boundaries

Array = NDArray[np.float64]
SPARE_M = 0.06
"""Distance kept beside an obstacle beyond what must be, because a plan cuts the corner of its bump."""
LENGTH_PER_SHIFT, SHORTEST_M = 2.2, 0.5
"""Half the length of a detour for each metre that it leads aside, and the least."""
OTHER_SIDE_M = 0.1
"""A detour goes over to the other side of an obstacle only if that is shorter by so much."""
# Chosen: detours are made anew only for a change that shows in them.
_MOVED_M = 0.01


@dataclass(frozen=True, slots=True)
class Detour:
    """Detour around one obstacle: point and direction of the line beside it, offset to the left, half its length."""

    x_m: float
    y_m: float
    along_x: float
    along_y: float
    left_m: float
    half_m: float


class Detours:
    """The detours around the obstacles that stand on a line.

    `turned_rad`: from the line's direction to the heading in which the robot follows it, pi backwards.
    """

    def __init__(self, footprint: Footprint, turned_rad: float = 0.0) -> None:
        self._footprint = footprint
        self._turned_rad = turned_rad
        self._line = np.empty((0, 2))
        self._directions = np.empty((0, 2))
        self._found: list[Detour] = []
        self._seen: Array | None = None
        self._keep_m = 0.0

    def set_line(self, line_m: Array) -> None:
        """Take another line, points (N, 2)."""
        steps = np.diff(line_m, axis=0)
        lengths = np.hypot(*steps.T)
        kept = lengths > 0.0
        counts = np.maximum(np.ceil(lengths[kept] / 0.05).astype(int), 1)
        parts = [
            start + np.arange(count)[:, None] / count * step
            for start, step, count in zip(line_m[:-1][kept], steps[kept], counts, strict=True)
        ]
        self._line = np.concatenate(parts) if parts else np.empty((0, 2))
        self._directions = np.repeat(steps[kept] / lengths[kept][:, None], counts, axis=0)
        self._seen = None

    def look_around(self, bounds: Boundaries, keep_m: float) -> None:
        """Find the detours anew where an obstacle, or the distance to keep, has changed by a centimetre or more."""
        circles = bounds.circles
        if not len(circles):
            self._found, self._seen = [], None
            return
        seen = self._seen
        same = seen is not None and seen.shape == circles.shape and abs(keep_m - self._keep_m) < _MOVED_M
        if same and seen is not None and np.abs(seen[:, :3] - circles[:, :3]).max(initial=0.0) < _MOVED_M:
            return
        self._seen, self._keep_m = circles.copy(), keep_m
        before = self._found
        self._found = [] if not len(self._line) else [
            found for circle in circles.tolist() if (found := self._around(bounds, circle, keep_m, before)) is not None
        ]  # fmt: skip

    def is_near(self, path: Array) -> bool:
        """Whether a path (N, 3) of x, y, yaw comes to where a detour begins."""
        return any(
            bool((np.hypot(path[:, 0] - one.x_m, path[:, 1] - one.y_m) < one.half_m + OTHER_SIDE_M).any())
            for one in self._found
        )

    def place(self, detours: NDArray[np.float32], x_m: float, y_m: float, origin_m: tuple[float, float]) -> None:
        """Put the nearest detours into the kernel's buffer, relative to the origin."""
        if not self._found:
            detours[5] = detours[DETOUR_COLUMNS + 5] = 0.0
            return
        nearest = sorted(self._found, key=lambda one: math.hypot(one.x_m - x_m, one.y_m - y_m))[:DETOURS]
        detours[:] = 0.0
        for number, one in enumerate(nearest):
            detours[number * DETOUR_COLUMNS : (number + 1) * DETOUR_COLUMNS] = (
                one.x_m - origin_m[0], one.y_m - origin_m[1], one.along_x, one.along_y, 1.0 / one.half_m, one.left_m,
                abs(one.left_m) + self._footprint.width,
            )  # fmt: skip

    def _around(self, bounds: Boundaries, circle: list[float], keep_m: float, before: list[Detour]) -> Detour | None:
        """Return the detour around a circle (x, y, radius, velocity); None where it does not stand in the way."""
        x, y, radius = circle[:3]
        off = np.array([x, y]) - self._line
        at = int(np.hypot(*off.T).argmin())
        along = self._directions[at]
        aside = float(along[0] * off[at, 1] - along[1] * off[at, 0])
        needed = radius + 0.5 * self._footprint.width + keep_m
        if math.hypot(*off[at]) >= needed:
            return None
        here = self._line[at]
        choices = [aside + needed + SPARE_M, aside - needed - SPARE_M]
        free = [left for left in choices if self._is_free(bounds, here, along, left)]
        choices = sorted(free or choices, key=abs)
        best = choices[0]
        for one in before:
            if len(choices) == DETOURS and math.hypot(one.x_m - here[0], one.y_m - here[1]) < radius + OTHER_SIDE_M:
                other = next((left for left in choices if left * one.left_m > 0.0), best)
                best = other if abs(other) < abs(best) + OTHER_SIDE_M else best
        half = max(SHORTEST_M, LENGTH_PER_SHIFT * abs(best)) + 0.5 * self._footprint.length
        return Detour(float(here[0]), float(here[1]), float(along[0]), float(along[1]), best, half)

    def _is_free(self, bounds: Boundaries, here: Array, along: Array, left_m: float) -> bool:
        """Whether the footprint is clear of everything at the detour's middle."""
        yaw_rad = math.atan2(along[1], along[0]) + self._turned_rad
        pose = (here[0] - along[1] * left_m, here[1] + along[0] * left_m, yaw_rad)
        return bool(bounds.clearance_m(np.array([pose]))[0] >= 0.0)
