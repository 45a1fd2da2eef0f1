"""Follow a path of way-points by arc length, at a constant speed, and stop at its end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import PathTask
from disco_hw.control.tasks.task import Prepared
from disco_hw.control.tasks.terms import follow, has_memory, looks_up, row_of, stage_cost, table_of, terminal_cost
from disco_hw.jit import (
    cast_like,
    int32,
    quick_length,
    quick_norm,
    quick_norm_and_inverse,
    scalar_function,
    specialise,
)
from disco_hw.waypoints import Waypoints

Array = NDArray[np.float64]

SPACING_M = 0.02
LOOK_BACK_M = 0.3
LOOK_AHEAD_M = 1.0
LOST_M = 1.0
SLOW_DOWN_S = 1.0
FARTHEST_STEP_M = 0.5
# Facing straight against the way costs as much as being so far off it.
AGAINST_M = 0.6
# Standing costs at least as much as being so far off the path, however slow it is to be driven.
STANDING_M = 0.4
# The last distance counts as much as it would over so much longer: turning in pushes the tracked point out at first.
TERMINAL_S = 1.0
# Where the way turns by more than SHARP from one TURN_M to the next, the robot stops, within REACHED_M, and turns.
SHARP_RAD = math.radians(125.0)
TURN_M = 0.15
REACHED_M = 0.05
# Entries of the table that rollouts see relative to the same point: few, as single precision tells 0.1 um of 1 m.
NEAR = 50


class PathTerms(NamedTuple):
    """What the kernel needs of a path: the part of its table that can be reached within the horizon.

    `table` (4 M,): for each piece between two entries, from one to the next, where it begins, x and y (m), and how far
    it goes in x and y (m). Places count in entries from where the robot is: `first` and `last` are the table's ends,
    `end` is where the robot stops, or infinite. `per_m`: entries a metre; `speed_m_s`; `speed_per_entry`: progress
    speed of one entry in a step (m/s); `slow_per_entry`: wanted speed for each entry left; `speed_weight`: of missing
    speed; `terminal_steps`: weight of the last distance.
    """

    table: Any
    first: Any
    last: Any
    end: Any
    per_m: Any
    speed_m_s: Any
    speed_per_entry: Any
    slow_per_entry: Any
    speed_weight: Any
    terminal_steps: Any


@dataclass(frozen=True, eq=False)
class Path:
    """Follow way-points by arc length: c = sqrt(e^2 + (progress - wanted)^2) + facing, e the distance to the path.

    The place on the path is carried along every rollout: each step moves it by the step's projection on the path's
    direction; so a path may cross itself. The speed of that is the progress, but no more than the forward speed; so
    standing still or spinning costs the whole wanted speed, and driving backwards twice of it. Facing is AGAINST_M
    times the part of the heading that is against the path's direction: backwards would else be the easier way, for it
    puts the tracked point before the axle. Wanted is `speed_m_s`, and less in the last second of an open path.

    Where the way turns sharply it is cut into pieces: rollouts end at the piece's end, the robot stops there, and then
    turns to the next, which it could not find by sampling as nothing is gained before the turn is half done. The path
    is closed if its last way-point is its first. Raises ValueError for way-points closer than the table's spacing
    throughout.
    """

    waypoints: Waypoints
    speed_m_s: float = 0.2
    _table: Array = field(init=False, repr=False)
    _closed: bool = field(init=False, repr=False)
    _spacing_m: float = field(init=False, repr=False)
    _bounds: Array = field(init=False, repr=False)

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
        table, spacing = np.column_stack([x, y, along_x, along_y]), float(distance[-1]) / count
        corners = sharp_turns(table[:, :2], closed, max(1, round(TURN_M / spacing)))
        bounds = [*corners, *(corner + count for corner in corners[:1])] if closed else [0, *corners, count]
        object.__setattr__(self, "_table", table)
        object.__setattr__(self, "_closed", closed)
        object.__setattr__(self, "_spacing_m", spacing)
        object.__setattr__(self, "_bounds", np.array(bounds, dtype=float))

    @classmethod
    def from_config(cls, task: PathTask) -> Path:
        """The path of robot.toml with the way-points that were read for it."""
        return cls(Waypoints(np.array(task.points)), task.speed_m_s)

    @property
    def table(self) -> Array:
        """The path in equal pieces of arc length: x, y (m) and the unit tangent of the piece that begins there."""
        return self._table

    @property
    def closed(self) -> bool:
        """Whether the path's end is its beginning."""
        return self._closed

    @property
    def sharp_turns(self) -> tuple[int, ...]:
        """Entries of the table at which the robot stops to turn."""
        ends = slice(0, -1) if self._closed else slice(1, -1)
        return tuple(self._bounds.astype(int)[ends].tolist())

    @property
    def spacing_m(self) -> float:
        """Arc length between two entries of the table."""
        return self._spacing_m

    def prepare(
        self, time_s: float, x_m: float, y_m: float, memory: float | None, step_s: float, horizon: int
    ) -> Prepared:
        """Terms for the kernel; the memory is the place on the path, in entries of the table.

        Rollouts count it from where they begin, and are relative to a point of the path nearby, so that a long path is
        as precise as a short one.
        """
        place, first, last = self.piece(self.place(x_m, y_m, memory))
        reach = horizon * math.ceil(FARTHEST_STEP_M / self._spacing_m) + 1
        near = _nearby(self, int(place) // NEAR, reach)
        low, high, end = place - reach, place + reach, math.inf
        if self._bounds.size:
            low, high, end = max(low, first), min(high, last), last - place
        begin, rows = int(low) - near.first, int(high - low)
        terms = PathTerms(
            near.pieces[4 * begin : 4 * (begin + rows)],
            np.float32(low - place),
            np.float32(high - place),
            np.float32(end),
            *_numbers(self, step_s),
        )
        return Prepared(terms, near.origin_m, 0.0, place)

    def piece(self, place: float) -> tuple[float, float, float]:
        """The piece that a place is on: the place, not less than the piece's first entry; its first and last entry.

        A piece of a closed path may go past the table's end, and so may the place. A path without sharp turns is one
        piece; of a closed one, which has no end, the last entry is the first again.
        """
        bounds, count = self._bounds, len(self._table) - 1
        if not bounds.size:
            return place % count, 0.0, float(count)
        if self._closed:
            place = place % count
            place += count if place < bounds[0] else 0.0
        at = min(int(np.searchsorted(bounds, place, side="right")), bounds.size - 1)
        return place, float(bounds[at - 1]), float(bounds[at])

    def place(self, x_m: float, y_m: float, before: float | None) -> float:
        """Entry of the table nearest to a position: near the one before, or anywhere without one or off the path.

        Near the one before means on the same piece; at the end of a piece the next one begins.
        """
        count, spacing = len(self._table) - 1, self._spacing_m
        if before is not None:
            here, first, last = self.piece(before)
            low, high = round(here - LOOK_BACK_M / spacing), round(here + LOOK_AHEAD_M / spacing)
            if self._bounds.size:
                low, high = max(low, int(first)), min(high, int(last))
            if low >= 0 and high <= count:
                rows = self._table[low : high + 1]
            else:
                rows = self._table[np.arange(low, high + 1) % count]
            square = (rows[:, 0] - x_m) ** 2 + (rows[:, 1] - y_m) ** 2
            nearest = int(square.argmin())
            if square[nearest] < LOST_M**2:
                found = float(low + nearest)
                if self._bounds.size and (self._closed or last < count) and (last - found) * spacing <= REACHED_M:
                    found = last
                return found % count if self._closed else found
        return float(np.argmin(np.hypot(self._table[:, 0] - x_m, self._table[:, 1] - y_m)))

    def instant_cost(self, time_s: float, x_m: float, y_m: float, forward_m_s: float) -> float:
        """Distance to the path and error of the longitudinal speed, as one length."""
        distance = np.hypot(self._table[:, 0] - x_m, self._table[:, 1] - y_m).min()
        return math.hypot(float(distance), forward_m_s - self.speed_m_s)

    def picture(self) -> Array:
        """The path as a polyline in the world frame, (N, 2)."""
        return self.waypoints.places_m


def sharp_turns(points: Array, closed: bool, reach: int) -> list[int]:
    """Indices of points (M + 1, 2) where the way turns by more than SHARP_RAD from `reach` points to the next `reach`.

    The sharpest of any that are within `reach` of one another; in rising order. The last point of a closed way is its
    first, and not told again.
    """
    count = len(points) - 1
    index = np.arange(count) if closed else np.arange(1, count)
    before, after = index - reach, index + reach
    before, after = (before % count, after % count) if closed else (np.maximum(before, 0), np.minimum(after, count))
    came, goes = points[index] - points[before], points[after] - points[index]
    alike = (came * goes).sum(axis=1)
    sharp = alike < math.cos(SHARP_RAD) * np.hypot(*came.T) * np.hypot(*goes.T)
    found: list[int] = []
    # Where the way turns back, points before the turn look as sharp, but not over as long a way.
    for at in np.flatnonzero(sharp)[np.argsort(alike[sharp], kind="stable")]:
        apart = [abs(int(index[at]) - other) for other in found]
        if all(min(gap, count - gap) > reach if closed else gap > reach for gap in apart):
            found.append(int(index[at]))
    return sorted(found)


class _Nearby(NamedTuple):
    """Part of a path, flat as in PathTerms, from the entry `first` on and relative to `origin_m`."""

    pieces: NDArray[np.float32]
    first: int
    origin_m: tuple[float, float]


@lru_cache(maxsize=8)
def _nearby(path: Path, block: int, reach: int) -> _Nearby:
    """The block of NEAR entries of a path, and `reach` more on both sides: round and round if it is closed."""
    table, count = path.table, len(path.table) - 1
    first, end = block * NEAR - reach, (block + 1) * NEAR + reach
    if not path.closed:
        first, end = max(first, 0), min(end, count)
    at = np.arange(first, end) % count
    here, there = table[at, :2], table[at + 1, :2]
    # An open path's last entry is one of its own: it is not the first.
    origin = table[block * NEAR % count if path.closed else block * NEAR, :2]
    pieces = np.hstack([here - origin, there - here]).astype(np.float32)
    x_m, y_m = origin.tolist()
    return _Nearby(pieces.reshape(-1), first, (x_m, y_m))


@lru_cache(maxsize=8)
def _numbers(path: Path, step_s: float) -> tuple[np.float32, ...]:
    """The terms from `per_m` on: those that no plan changes."""
    spacing, speed = path.spacing_m, path.speed_m_s
    return tuple(
        np.float32(value)
        for value in (
            1.0 / spacing,
            speed,
            spacing / step_s,
            spacing / SLOW_DOWN_S,
            max(1.0, STANDING_M / speed),
            TERMINAL_S / step_s,
        )
    )


@scalar_function
def _offset(task: Any, place: Any, x: Any, y: Any, piece: Any) -> Any:
    """Position relative to the path's point at a place (m), and the direction of the path there; `piece` is its row."""
    begin_x, begin_y, step_x, step_y = piece
    part = place - np.floor(min(place, task.last - cast_like(1.0, place)))
    _, per_m = quick_norm_and_inverse(step_x, step_y)
    return x - (begin_x + part * step_x), y - (begin_y + part * step_y), step_x * per_m, step_y * per_m


def _is_path(task: Any) -> bool:
    return getattr(task, "instance_class", None) is PathTerms


@specialise(stage_cost)
def _stage_cost(
    task: Any, memory: Any, step: Any, x_old: Any, y_old: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, forward: Any,
    found: Any,
) -> Callable[..., Any] | None:  # fmt: skip
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
        found: Any,
    ) -> Any:
        off_x, off_y, along_x, along_y = _offset(task, memory, x, y, found[1:])
        against = max(-(cos_yaw * along_x + sin_yaw * along_y), cast_like(0.0, x))
        return quick_length(off_x, off_y, found[0]) + cast_like(AGAINST_M, x) * against, memory

    return cost


@specialise(follow)
def _follow(task: Any, memory: Any, x: Any, y: Any, forward: Any, found: Any) -> Callable[..., Any] | None:
    if not _is_path(task):
        return None

    def after(task: Any, memory: Any, x: Any, y: Any, forward: Any, found: Any) -> Any:
        off_x, off_y, along_x, along_y = _offset(task, memory, x, y, found[1:])
        farthest = cast_like(FARTHEST_STEP_M, x)
        along = min(max(off_x * along_x + off_y * along_y, -farthest), farthest) * task.per_m
        wanted = min(task.speed_m_s, (task.end - memory) * task.slow_per_entry)
        missing = task.speed_weight * (wanted - min(along * task.speed_per_entry, forward))
        # In this order, so that what is no number becomes a place, and the cost tells of it.
        return min(task.last, max(task.first, memory + along)), missing

    return after


@specialise(row_of)
def _row_of(task: Any, memory: Any) -> Callable[..., Any] | None:
    if not _is_path(task):
        return None
    return lambda task, memory: int32(np.floor(min(memory, task.last - cast_like(1.0, memory))) - task.first)


@specialise(terminal_cost)
def _terminal_cost(
    task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any
) -> Callable[..., Any] | None:
    if not _is_path(task):
        return None

    def cost(task: Any, memory: Any, x: Any, y: Any, cos_yaw: Any, sin_yaw: Any, found: Any) -> Any:
        off_x, off_y, _, _ = _offset(task, memory, x, y, found[1:])
        return task.terminal_steps * quick_norm(off_x, off_y)

    return cost


@specialise(has_memory)
def _has_memory(task: Any) -> Callable[..., Any] | None:
    return (lambda task: False) if _is_path(task) else None


@specialise(looks_up)
def _looks_up(task: Any) -> Callable[..., Any] | None:
    return (lambda task: True) if _is_path(task) else None


@specialise(table_of)
def _table_of(task: Any) -> Callable[..., Any] | None:
    return (lambda task: task.table) if _is_path(task) else None
