"""Signed distance from a rectangle at many poses to a fence and to obstacles, and whether a task stays within them.

And the lines that draw a fence, circles and a footprint.

Positive: the whole footprint is inside of `keep_in` and outside of everything else, and so far from the nearest of
them. Negative: how deep it is where it must not be. The clearance changes by at most as much as a corner moves, as long
as it is positive.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from disco_hw.fence import Circle, Fence, Footprint, Point, Polygon

Array = NDArray[np.float64]
FREE_M = 1e6
"""Clearance where there is nothing to keep away from."""
# Chosen: a longer outline is looked at less closely, rather than for longer.
_MOST_POSES = 4000
_ROUND = np.linspace(0.0, 2.0 * np.pi, 49)


@dataclass(frozen=True, slots=True)
class MovingCircle:
    """A circle to keep out of: its centre (m) at time zero, its velocity (m/s), its radius (m)."""

    x_m: float
    y_m: float
    radius_m: float
    vx_m_s: float = 0.0
    vy_m_s: float = 0.0


@dataclass(frozen=True, eq=False)
class _Outline:
    """Polygon with its edges as arrays: where they begin (E, 2) and the way along each (E, 2)."""

    begin: Array
    way: Array
    keep_in: bool


class Boundaries:
    """Boundaries that a footprint must keep away from.

    `circles` (C, 5) to keep out of: x, y, radius, and velocity along x and y.
    """

    def __init__(self, footprint: Footprint, fence: Fence, obstacles: Sequence[MovingCircle] = ()) -> None:
        self.footprint = footprint
        self.fence = fence
        shapes = [(fence.keep_in, True)] if fence.keep_in is not None else []
        shapes += [(shape, False) for shape in fence.keep_out]
        self._keep_in = [shape for shape, inside in shapes if inside and isinstance(shape, Circle)]
        fixed = [shape for shape, inside in shapes if not inside and isinstance(shape, Circle)]
        self._outlines = [_outline(shape, inside) for shape, inside in shapes if not isinstance(shape, Circle)]
        self._fixed = [MovingCircle(*circle.center, circle.radius_m) for circle in fixed]
        self.circles = _table(self._fixed)
        self._half = np.array([0.5 * footprint.length, 0.5 * footprint.width])
        self._corners = np.array(footprint.corners_m()) - [footprint.ahead, 0.0]
        self.set_obstacles(obstacles)

    def set_obstacles(self, obstacles: Sequence[MovingCircle]) -> None:
        """Keep away from these circles too, in place of those before."""
        self.circles = _table([*self._fixed, *obstacles])

    @property
    def polygons(self) -> list[tuple[Array, bool]]:
        """Corners (V, 2) of each polygon, and whether it is the one to stay in."""
        return [(outline.begin, outline.keep_in) for outline in self._outlines]

    @property
    def keep_in_circle(self) -> Circle | None:
        """The circle to stay in, if the fence is one."""
        return self._keep_in[0] if self._keep_in else None

    def clearance_m(self, poses: Array, times_s: Array | None = None, within_m: float = math.inf) -> Array:
        """Least of the clearances (N,) to all shapes; see `clearances_m`."""
        return np.asarray(self.clearances_m(poses, times_s, within_m).min(axis=1))

    def clearances_m(self, poses: Array, times_s: Array | None = None, within_m: float = math.inf) -> Array:
        """Clearance (N, M) of the footprint to each shape at poses (N, 3) of the tracked point: x, y (m), yaw (rad).

        `times_s` (N,): when the footprint is there, for obstacles that move. What is farther than `within_m` from all
        of the poses may be given as that. Without any shape there is one column of FREE_M.
        """
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        ahead = self.footprint.ahead
        centers = np.stack([poses[:, 0] + ahead * cos, poses[:, 1] + ahead * sin], axis=1)
        farthest = min(within_m, FREE_M)
        columns = [np.full((len(poses), 1), farthest)]
        for circle in self._keep_in:
            corners = self._world_corners(centers, cos, sin)
            off = np.hypot(corners[..., 0] - circle.center[0], corners[..., 1] - circle.center[1])
            columns.append(circle.radius_m - off.max(axis=1, keepdims=True))
        if len(self.circles):
            columns.append(self._from_circles(centers, cos, sin, times_s))
        for outline in self._outlines:
            columns.append(self._from_polygon(outline, centers, cos, sin, farthest)[:, None])
        return np.concatenate(columns, axis=1)

    def _world_corners(self, centers: Array, cos: Array, sin: Array) -> Array:
        x, y = self._corners.T
        return np.stack(
            [
                centers[:, :1] + cos[:, None] * x - sin[:, None] * y,
                centers[:, 1:] + sin[:, None] * x + cos[:, None] * y,
            ],
            axis=2,
        )

    def _from_circles(self, centers: Array, cos: Array, sin: Array, times_s: Array | None) -> Array:
        """Clearance (N, C) to the circles to keep out of."""
        x, y, radius, vx, vy = self.circles.T
        at_s = np.zeros(len(centers)) if times_s is None else times_s
        dx = x + vx * at_s[:, None] - centers[:, :1]
        dy = y + vy * at_s[:, None] - centers[:, 1:]
        forward = np.abs(cos[:, None] * dx + sin[:, None] * dy) - self._half[0]
        aside = np.abs(cos[:, None] * dy - sin[:, None] * dx) - self._half[1]
        outside = np.hypot(np.maximum(forward, 0.0), np.maximum(aside, 0.0))
        # Zero outside of the rectangle; within it how far the centre is from the nearest side, negative.
        inside = np.minimum(np.maximum(forward, aside), 0.0)
        return np.asarray(outside + inside - radius)

    def _from_polygon(self, outline: _Outline, centers: Array, cos: Array, sin: Array, within_m: float) -> Array:
        """Clearance (N,) to one polygon."""
        near = self._near_edges(outline, centers, within_m)
        found = np.full(len(centers), within_m)
        if near.any():
            off, overlap = self._to_edges(outline.begin[near], outline.way[near], centers, cos, sin)
            found = np.where((overlap > 0.0).any(axis=1), 0.0, np.minimum(off.min(axis=(1, 2)), within_m))
        wrong = (_is_within(centers, outline) != outline.keep_in) | (found <= 0.0)
        if wrong.any():
            centers, cos, sin = centers[wrong], cos[wrong], sin[wrong]
            off, overlap = self._to_edges(outline.begin, outline.way, centers, cos, sin)
            corners = self._world_corners(centers, cos, sin)
            outside = _is_within(corners.reshape(-1, 2), outline).reshape(-1, 4) != outline.keep_in
            depth = np.where(outside, off[:, :, :4].min(axis=1), 0.0).max(axis=1)
            found[wrong] = -np.maximum(depth, np.maximum(overlap, 0.0).max(axis=1))
        return found

    def _near_edges(self, outline: _Outline, centers: Array, within_m: float) -> NDArray[np.bool_]:
        """Return which edges (E,) can be within so far of the footprint at one of the centres."""
        middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
        reach = float(np.hypot(*(centers - middle).T).max()) + float(np.hypot(*self._half)) + within_m
        dx, dy = (middle - outline.begin).T
        along, across = outline.way.T
        part = np.clip((dx * along + dy * across) / (along**2 + across**2), 0.0, 1.0)
        return np.asarray(np.hypot(dx - part * along, dy - part * across) <= reach)

    def _to_edges(self, begin: Array, way: Array, centers: Array, cos: Array, sin: Array) -> tuple[Array, Array]:
        """Distances (N, E, 5) of the four corners from edges (E, 2), and of the edge's begin from the rectangle.

        And how far each edge reaches into the rectangle (N, E): the shortest way that parts them; not positive if it
        does not. By the theorem of separating axes: the rectangle's own two and the edge's normal.
        """
        length, width = self._half
        cos, sin = cos[:, None], sin[:, None]
        dx, dy = begin[:, 0] - centers[:, :1], begin[:, 1] - centers[:, 1:]
        forward, aside = cos * dx + sin * dy, cos * dy - sin * dx
        along, across = cos * way[:, 0] + sin * way[:, 1], cos * way[:, 1] - sin * way[:, 0]
        square = way[:, 0] ** 2 + way[:, 1] ** 2
        corner_x, corner_y = self._corners[:, 0] - forward[..., None], self._corners[:, 1] - aside[..., None]
        along_3, across_3 = along[..., None], across[..., None]
        part = np.clip((corner_x * along_3 + corner_y * across_3) / square[:, None], 0.0, 1.0)
        off = np.hypot(corner_x - part * along_3, corner_y - part * across_3)
        out = np.hypot(np.maximum(np.abs(forward) - length, 0.0), np.maximum(np.abs(aside) - width, 0.0))
        over_x = length - np.maximum(np.minimum(forward, forward + along), -np.maximum(forward, forward + along))
        over_y = width - np.maximum(np.minimum(aside, aside + across), -np.maximum(aside, aside + across))
        normal = length * np.abs(across) + width * np.abs(along) - np.abs(forward * across - aside * along)
        overlap = np.minimum(np.minimum(over_x, over_y), normal / np.sqrt(square))
        return np.concatenate([off, out[..., None]], axis=2), np.asarray(overlap)


def _is_within(points: Array, outline: _Outline) -> NDArray[np.bool_]:
    """Whether points (P, 2) are within the polygon: by the parity of the edges to the right of each; (P,)."""
    x, y = points[:, :1], points[:, 1:]
    begin_x, begin_y = outline.begin.T
    along, across = outline.way.T
    crosses = (begin_y > y) != (begin_y + across > y)
    meets = begin_x + (y - begin_y) / np.where(across == 0.0, 1.0, across) * along
    return np.asarray((crosses & (meets > x)).sum(axis=1) % 2 == 1)


def _outline(polygon: Polygon, keep_in: bool) -> _Outline:
    begin = np.array(polygon, dtype=np.float64)
    return _Outline(begin, np.roll(begin, -1, axis=0) - begin, keep_in)


def _table(circles: Sequence[MovingCircle]) -> Array:
    rows = [(one.x_m, one.y_m, one.radius_m, one.vx_m_s, one.vy_m_s) for one in circles]
    return np.array(rows, dtype=np.float64).reshape(-1, 5)


def along_line(outline_m: Array, spacing_m: float = 0.02) -> Array:
    """Poses (N, 3) of a robot on a line of points (M, 2), facing along it, at most `spacing_m` apart.

    On a line of over 4000 such spacings they are farther apart.
    """
    steps = np.diff(outline_m, axis=0)
    lengths = np.hypot(*steps.T)
    spacing_m = max(spacing_m, float(lengths.sum()) / _MOST_POSES)
    steps, starts, lengths = steps[lengths > 0.0], outline_m[:-1][lengths > 0.0], lengths[lengths > 0.0]
    poses = []
    for start, step, length in zip(starts, steps, lengths, strict=True):
        part = np.linspace(0.0, 1.0, math.ceil(length / spacing_m) + 1)
        yaw = math.atan2(step[1], step[0])
        poses.append(np.column_stack([start + part[:, None] * step, np.full(len(part), yaw)]))
    return np.concatenate(poses) if poses else np.empty((0, 3))


def first_breach(boundaries: Boundaries, poses: Array) -> tuple[Point, float] | None:
    """Where (m) the footprint on these poses is deepest outside, and how far (m); None if it never is."""
    if not len(poses):
        return None
    clearance = boundaries.clearance_m(poses)
    worst = int(clearance.argmin())
    if clearance[worst] >= 0.0:
        return None
    return (float(poses[worst, 0]), float(poses[worst, 1])), -float(clearance[worst])


class TaskLine(Protocol):
    """The line of a task; those of `disco_hw.tasks` have it."""

    @property
    def start(self) -> tuple[float, float, float]:
        """Start of the line and the heading there: x, y (m), yaw (rad)."""

    def outline_m(self) -> NDArray[np.float64]:
        """Return the line as points (N, 2)."""


def task_breach(fence: Fence, footprint: Footprint, course: TaskLine) -> str | None:
    """Say where a robot on this task would leave the fence, and how far; None if it stays inside.

    The robot is taken to face along the line. Where it turns at corners the guard sees to the rest.
    """
    if not fence.is_set:
        return None
    boundaries = Boundaries(footprint, fence)
    start = first_breach(boundaries, np.array([course.start], dtype=np.float64))
    if start is not None:
        (x, y), far = start
        return f"the task starts at ({x:.2f}, {y:.2f}), where the footprint is {far:.2f} m outside"
    crossing = first_breach(boundaries, along_line(np.asarray(course.outline_m(), dtype=np.float64)))
    if crossing is not None:
        (x, y), far = crossing
        return f"the task's line crosses it near ({x:.2f}, {y:.2f}): the footprint is {far:.2f} m outside there"
    return None


def fence_outlines(fence: Fence) -> list[Array]:
    """Return the fence's shapes as closed lines (N, 2)."""
    shapes = [*(() if fence.keep_in is None else (fence.keep_in,)), *fence.keep_out]
    return [
        circle_outline(*shape.center, shape.radius_m) if isinstance(shape, Circle) else _closed(shape)
        for shape in shapes
    ]


def footprint_outline(footprint: Footprint, pose: tuple[float, float, float]) -> Array:
    """Return the footprint at a pose of the tracked point as a closed line (5, 2)."""
    x_m, y_m, yaw_rad = pose
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    return _closed([(x_m + cos * x - sin * y, y_m + sin * x + cos * y) for x, y in footprint.corners_m()])


def circle_outline(x_m: float, y_m: float, radius_m: float) -> Array:
    """Return a circle as a closed line (N, 2)."""
    return np.stack((x_m + radius_m * np.cos(_ROUND), y_m + radius_m * np.sin(_ROUND)), axis=1)


def _closed(points: ArrayLike) -> Array:
    found = np.asarray(points, dtype=np.float64)
    return np.concatenate((found, found[:1]))
