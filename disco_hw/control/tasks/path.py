"""Follow a path of way-points by arc length, at a constant speed, and stop at its end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import PathTask
from disco_hw.control.blocks import U
from disco_hw.control.tasks.terms import has_memory, stage_cost, terminal_cost
from disco_hw.model.jit import cast_like, quick_norm, scalar_function, specialise
from disco_hw.waypoints import Waypoints

Array = NDArray[np.float64]

SPACING_M = 0.02
LOOK_BACK_M = 0.3
LOOK_AHEAD_M = 1.0
LOST_M = 1.0
SLOW_DOWN_S = 1.0
FARTHEST_STEP_M = 0.5


class PathTerms(NamedTuple):
    """What the kernel needs of a path: a table of points a spacing apart.

    `x`, `y` (m) and unit tangents `along_x`, `along_y`, each (M + 1,), the last entry repeating the first of a closed
    path; `last`: largest position in the table, M; `closed`; `per_m`: entries a metre; `speed_m_s`; `speed_per_entry`:
    progress speed of one entry in a step (m/s); `slow_per_entry`: wanted speed for each entry left of an open path.
    """

    x: Any
    y: Any
    along_x: Any
    along_y: Any
    last: Any
    closed: Any
    per_m: Any
    speed_m_s: Any
    speed_per_entry: Any
    slow_per_entry: Any


@dataclass(frozen=True, eq=False)
class Path:
    """Follow way-points by arc length: c = sqrt(e^2 + (progress - wanted)^2), e the distance to the path.

    The place on the path is carried along every rollout: each step moves it by the step's projection on the path's
    direction, whose speed is the progress; so standing still or spinning costs the whole wanted speed, and a path may
    cross itself. Wanted is `speed_m_s`, and less in the last second of an open path. The path is closed if its last
    way-point is its first. Raises ValueError for way-points closer than the table's spacing throughout.
    """

    waypoints: Waypoints
    speed_m_s: float = 0.2
    _table: Array = field(init=False, repr=False)
    _closed: bool = field(init=False, repr=False)
    _spacing_m: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        places = self.waypoints.places_m
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
        count = round(distance[-1] / SPACING_M)
        if count < 1:
            raise ValueError(f"the path is {distance[-1]} m long; it must be longer than {SPACING_M} m")
        at = np.linspace(0.0, distance[-1], count + 1)
        x, y = np.interp(at, distance, places[:, 0]), np.interp(at, distance, places[:, 1])
        closed = bool(np.hypot(*(places[0] - places[-1])) < SPACING_M)
        step_x, step_y = np.diff(x), np.diff(y)
        length = np.maximum(np.hypot(step_x, step_y), 1e-12)
        along_x = np.append(step_x / length, (step_x / length)[0 if closed else -1])
        along_y = np.append(step_y / length, (step_y / length)[0 if closed else -1])
        object.__setattr__(self, "_table", np.column_stack([x, y, along_x, along_y]))
        object.__setattr__(self, "_closed", closed)
        object.__setattr__(self, "_spacing_m", float(distance[-1]) / count)

    @classmethod
    def from_config(cls, task: PathTask) -> Path:
        """The path of robot.toml with the way-points that were read for it."""
        return cls(Waypoints(np.array(task.points)), task.speed_m_s)

    @property
    def origin_m(self) -> tuple[float, float]:
        """World position that rollouts are relative to: the path's first point."""
        x, y = self._table[0, :2].tolist()
        return x, y

    @property
    def table(self) -> Array:
        """The path in equal pieces of arc length: x, y (m) and the unit tangent of the piece that begins there."""
        return self._table

    @property
    def closed(self) -> bool:
        """Whether the path's end is its beginning."""
        return self._closed

    @property
    def spacing_m(self) -> float:
        """Arc length between two entries of the table."""
        return self._spacing_m

    def terms(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> tuple[Any, float]:
        """Terms for the kernel; the memory is the place on the path, in entries of the table."""
        f32 = np.float32
        columns = [np.ascontiguousarray(c, dtype=f32) for c in (self._table - [*self.origin_m, 0.0, 0.0]).T]
        spacing = self.spacing_m
        last, speed = f32(len(self._table) - 1), f32(self.speed_m_s)
        per_m, speed_per_entry, slow_per_entry = f32(1.0 / spacing), f32(spacing / step_s), f32(spacing / SLOW_DOWN_S)
        x, y, along_x, along_y = columns
        terms = PathTerms(x, y, along_x, along_y, last, self._closed, per_m, speed, speed_per_entry, slow_per_entry)
        return terms, self.place(x_m, y_m, memory)

    def place(self, x_m: float, y_m: float, before: float | None) -> float:
        """Entry of the table nearest to a position: near the one before, or anywhere without one or off the path."""
        last, spacing = len(self._table) - 1, self._spacing_m
        if before is not None:
            window = np.arange(round(before - LOOK_BACK_M / spacing), round(before + LOOK_AHEAD_M / spacing) + 1)
            window = np.unique(window % last if self._closed else np.clip(window, 0, last))
            distance = np.hypot(self._table[window, 0] - x_m, self._table[window, 1] - y_m)
            if distance.min() < LOST_M:
                return float(window[np.argmin(distance)])
        return float(np.argmin(np.hypot(self._table[:, 0] - x_m, self._table[:, 1] - y_m)))

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """Distance to the path and error of the longitudinal speed, as one length."""
        distance = np.hypot(self._table[:, 0] - x_m, self._table[:, 1] - y_m).min()
        return math.hypot(float(distance), forward_m_s - self.speed_m_s)

    def picture(self) -> Array:
        """The path as a polyline in the world frame, (N, 2)."""
        return self.waypoints.places_m


@scalar_function
def _moved(task: Any, place: Any, by: Any) -> Any:
    """Place on the path, `by` entries on: round a closed path, up to the ends of an open one."""
    zero = cast_like(0.0, place)
    on = place + by
    if task.closed:
        on = on + task.last if on < zero else on
        return on - task.last if on >= task.last else on
    return min(max(on, zero), task.last)


@scalar_function
def _offset(task: Any, place: Any, x: Any, y: Any) -> Any:
    """Position relative to the path's point at a place (m), and the direction of the path there."""
    before = min(place, task.last - cast_like(1.0, place))
    at = U(int(before))
    part = place - cast_like(int(before), place)
    point_x = task.x[at] + part * (task.x[at + U(1)] - task.x[at])
    point_y = task.y[at] + part * (task.y[at + U(1)] - task.y[at])
    return x - point_x, y - point_y, task.along_x[at], task.along_y[at]


@scalar_function
def _wanted(task: Any, place: Any) -> Any:
    """Wanted progress speed (m/s)."""
    if task.closed:
        return task.speed_m_s
    return min(task.speed_m_s, (task.last - place) * task.slow_per_entry)


def _is_path(task: Any) -> bool:
    return getattr(task, "instance_class", None) is PathTerms


@specialise(stage_cost)
def _stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any
) -> Callable[..., Any] | None:
    if not _is_path(task):
        return None

    def cost(
        task: Any,
        memory: Any,
        step: Any,
        x_old: Any,
        y_old: Any,
        x: Any,
        y: Any,
        cos_yaw: Any,
        sin_yaw: Any,
        forward: Any,
    ) -> Any:
        off_x, off_y, along_x, along_y = _offset(task, memory, x, y)
        farthest = cast_like(FARTHEST_STEP_M, x)
        along = min(max(off_x * along_x + off_y * along_y, -farthest), farthest) * task.per_m
        place = _moved(task, memory, along)
        off_x, off_y, along_x, along_y = _offset(task, place, x, y)
        missing = _wanted(task, memory) - along * task.speed_per_entry
        return quick_norm(quick_norm(off_x, off_y), missing), place

    return cost


@specialise(terminal_cost)
def _terminal_cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any) -> Callable[..., Any] | None:
    if not _is_path(task):
        return None
    return lambda task, memory, x, y, cos_yaw, sin_yaw: cast_like(0.0, x)


@specialise(has_memory)
def _has_memory(task: Any) -> Callable[..., Any] | None:
    return (lambda task: True) if _is_path(task) else None
