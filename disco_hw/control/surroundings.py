"""The fence and the obstacles around a plan: which shapes it can come near, and how far to keep from them."""

from __future__ import annotations

import math
from collections.abc import Callable
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.detours import Detours
from disco_hw.control.kernel import Floats, aligned_zeros
from disco_hw.control.kernel.avoid import (
    COLUMNS,
    DETOUR_COLUMNS,
    DETOURS,
    FASTEST,
    KEEP,
    LOOK_EVERY,
    MOST_SHAPES,
    STEP_LENGTH,
    TOUCH_COST,
    Area,
    place_shapes,
    touches,
)
from disco_hw.control.plan import CommandLimits, ramp_to_zero
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.state_prediction import PlanStart
from disco_hw.fence import Footprint
from disco_hw.fence.clearance import Boundaries, circle_outline
from disco_hw.jit import compiled_for

Array = NDArray[np.float64]
TRAPPED_PART = 0.5
"""A plan all of whose samples touch something for so long has no way out."""


class Surroundings:
    """Fence and obstacles that a planner keeps away from, in the buffers that its kernel reads.

    The fence's margin, and its breach probability with the pose's deviation, make the distance to keep.
    `turned_rad`: from the line's direction to the heading in which the robot follows it, pi backwards.
    """

    def __init__(
        self,
        footprint: Footprint,
        step_s: float,
        horizon: int,
        speed_m_s: float,
        turned_rad: float = 0.0,
    ) -> None:
        self.speed_m_s = speed_m_s
        """The task's speed."""
        self._detours = Detours(footprint, turned_rad)
        self._footprint = footprint
        self._margin_m = self._deviations = 0.0
        self._horizon = horizon
        self.trapped_cost = TOUCH_COST * TRAPPED_PART * horizon / LOOK_EVERY
        """Cost from which on a sequence touches something for most of the horizon; from TOUCH_COST on it touches."""
        self._table = np.empty((0, COLUMNS))
        self._edges = np.empty((0, COLUMNS))
        self._bounds: Boundaries | None = None
        self._circles: bytes | None = None
        self._place: Callable[..., None] | None = None
        self._touches: Callable[..., bool] | None = None
        self.area = Area(
            aligned_zeros(MOST_SHAPES * COLUMNS),
            np.zeros(1, np.int64),
            np.array(
                [0.5 * footprint.length, 0.5 * footprint.width, footprint.ahead, 0.0, step_s, 0.0, 0.0], np.float32
            ),
            np.zeros(DETOURS * DETOUR_COLUMNS, np.float32),
            np.zeros(MOST_SHAPES),
        )

    def look_around(self, bounds: Boundaries, deviation_m: float) -> None:
        """Keep away from these boundaries; `deviation_m`: of the corner whose place is known least."""
        circles = bounds.circles
        if bounds is not self._bounds:
            self._bounds, self._edges, self._circles = bounds, _edges(bounds), None
            self._margin_m = bounds.fence.margin_m
            self._deviations = NormalDist().inv_cdf(1.0 - bounds.fence.max_breach_probability)
        seen = circles.tobytes()
        if seen != self._circles:
            self._circles = seen
            moving = np.zeros((len(circles), COLUMNS))
            moving[:, [0, 1, 5, 6, 7]] = circles
            self._table = np.concatenate((self._edges, moving))
        keep_m = self._margin_m + self._deviations * deviation_m
        self.area.body[KEEP] = keep_m
        self._detours.look_around(bounds, keep_m)

    def set_line(self, line_m: Array) -> None:
        """Drive around what stands on this line, points (N, 2)."""
        self._detours.set_line(line_m)

    def allows(self, paths: Array, origin_m: tuple[float, float]) -> bool:
        """Whether paths (L, N, 3) of x, y, yaw need no detour and keep the footprint far enough from everything.

        They begin where `place` was last asked for, with that origin; the first pose is that of the plan's begin, the
        others follow a step apart.
        """
        if self._bounds is None:
            return True
        if any(self._detours.is_near(path) for path in paths):
            return False
        body = self.area.body
        looked_m = float(body[FASTEST] * body[STEP_LENGTH]) * self._horizon
        if np.hypot(*(paths[..., :2] - paths[:, :1, :2]).T).max() > looked_m:
            # Beyond what was looked for.
            return False
        if not self.area.number[0]:
            return True
        assert self._touches is not None, "`place` comes first"
        return not self._touches(self.area, (paths - (*origin_m, 0.0)).astype(np.float32))

    def place(self, x_m: float, y_m: float, origin_m: tuple[float, float], speed_m_s: float) -> Area:
        """Put the shapes that a plan from here can reach into the kernel's buffers, relative to the origin.

        `speed_m_s`: the fastest that the plan may go.
        """
        time_s = self._horizon * float(self.area.body[STEP_LENGTH])
        near_m = self._footprint.reach_m + float(self.area.body[KEEP])
        self.area.body[FASTEST:] = speed_m_s, near_m
        reach_m = speed_m_s * time_s + near_m
        arguments = self.area, self._table, x_m, y_m, *origin_m, reach_m, time_s
        if self._place is None:
            self._place = compiled_for(place_shapes, *arguments)
            self._touches = compiled_for(touches, self.area, np.zeros((1, 1, 3), np.float32))
        self._place(*arguments)
        self._detours.place(self.area.detours, x_m, y_m, origin_m)
        return self.area


def keeps_clear(
    around: Surroundings, points: RolloutPoints, begin: PlanStart, commands: Array, start: Floats,
    limits: CommandLimits, step_s: float,
) -> bool:  # fmt: skip
    """Whether a robot that does these commands (N, 2) and then stops keeps clear of everything under every point.

    `start` (10,) is that of `SkidSteer`.
    """
    stop_steps = math.ceil(np.abs(commands[-1]).max() / (limits.acceleration_rad_s2 * step_s)) + 1
    stopped = np.concatenate([commands, ramp_to_zero(commands[-1], limits, step_s, stop_steps)])
    runs = [begin.point_path(points.run, stopped, point) for point in range(points.weights.size)]
    origin_x_m, origin_y_m = (begin.state[:2] - start[:2]).tolist()
    return around.allows(np.array(runs), (origin_x_m, origin_y_m))


def _edges(bounds: Boundaries) -> Array:
    """Return the edges of all polygons, and of one within the circle to stay in, as capsules of no radius."""
    outlines = [corners for corners, _ in bounds.polygons]
    circle = bounds.keep_in_circle
    if circle is not None:
        outlines.append(circle_outline(*circle.center, circle.radius_m)[:-1])
    rows = []
    for corners in outlines:
        way = np.roll(corners, -1, axis=0) - corners
        length = np.hypot(*way.T)
        rows.append(np.column_stack([corners, way / length[:, None], length, np.zeros((len(corners), 3))]))
    return np.concatenate(rows) if rows else np.empty((0, COLUMNS))
