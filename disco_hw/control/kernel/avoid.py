"""Cost of a rollout for touching the fence or an obstacle: the footprint against each near shape at each step.

A shape is a capsule: a segment with a radius, which may move. A circle is one of no length, an edge of a polygon one of
no radius. The rectangle's reach towards the nearest point of the segment is subtracted from the distance, which is
exact for walls and never too far for anything convex. Every other step is looked at: between two of them no corner
comes nearer than half the way, which is kept in addition.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.control.kernel import Floats, U
from disco_hw.jit import kernel_function, scalar_function, specialise
from disco_hw.tasks import constant, norm_and_inverse

COLUMNS = 8
"""Of a shape: begin x, y, direction x, y, length, radius, velocity x, y (m, m/s), relative to the task's origin."""
# Chosen: the nearest ones; each takes time of every rollout.
MOST_SHAPES = 12
TOUCH_COST, TOUCH_COST_PER_M = 80.0, 800.0
"""What each look costs at which the footprint touches a shape, and each metre of overlap then."""
LOOK_EVERY = 2
"""Steps from one look to the next."""
ROUNDING_M = 1e-3
"""More than distances in single precision are wrong."""


DETOURS, DETOUR_COLUMNS = 2, 7
"""How many obstacles on the line are driven around at once; of each middle x, y, the line's direction x, y, one over
half the detour's length (1/m), how far to the left it leads (m), and how far aside of the line it counts (m)."""


HALF_LENGTH, HALF_WIDTH, CENTRE_AHEAD, KEEP, STEP_LENGTH, FASTEST, REACH = range(7)
"""Places in `Area.body`."""


class Area(NamedTuple):
    """The fence and obstacles that rollouts keep away from, as arrays for the kernel.

    `shapes` (MOST_SHAPES * COLUMNS,); `number` (1,) of them are there. `body` (7,): half the footprint's length and
    width, how far its centre lies ahead of the tracked point, the distance to keep (m), the length of a step (s), the
    fastest that a plan goes (m/s), and the reach of the footprint with the distance to keep (m).
    `detours` (DETOURS * DETOUR_COLUMNS,): around obstacles on the task's line.
    `away` (MOST_SHAPES,): how far each shape is from where the plan begins (m).
    """

    shapes: Floats
    number: NDArray[np.int64]
    body: Floats
    detours: Floats
    away: NDArray[np.float64]


@kernel_function
def place_shapes(
    area: Area, table: NDArray[np.float64], x_m: float, y_m: float, origin_x_m: float, origin_y_m: float,
    reach_m: float, time_s: float,
) -> None:  # fmt: skip
    """Copy those rows of `table` (N, COLUMNS) that a plan from here can reach to `area`, relative to an origin.

    Where they are more than MOST_SHAPES, the nearest. A shape that moves may come nearer for `time_s`.
    """
    count = 0
    farthest, farthest_at = -1e9, 0
    for n in range(table.shape[0]):
        off_x, off_y = x_m - table[n, 0], y_m - table[n, 1]
        along = min(max(off_x * table[n, 2] + off_y * table[n, 3], 0.0), table[n, 4])
        away = math.hypot(off_x - along * table[n, 2], off_y - along * table[n, 3]) - table[n, 5]
        away -= time_s * math.hypot(table[n, 6], table[n, 7])
        if away > reach_m:
            continue
        at = count
        if count < MOST_SHAPES:
            count += 1
        elif away < farthest:
            at = farthest_at
        else:
            continue
        for column in range(COLUMNS):
            area.shapes[at * COLUMNS + column] = table[n, column]
        area.shapes[at * COLUMNS] -= origin_x_m
        area.shapes[at * COLUMNS + 1] -= origin_y_m
        area.away[at] = away
        farthest = -1e9
        for k in range(count):
            if area.away[k] > farthest:
                farthest, farthest_at = area.away[k], k
    area.number[0] = count


Bend: TypeAlias = tuple[float, float, float, float, float, float, float]
Bends: TypeAlias = tuple[Bend, Bend] | None
"""The numbers of both detours, or None without an area: read once, as a loop over samples must not look for them."""


def bends_of(area: Area | None, straight: bool | None) -> Bends:
    """Return an area's detours, two tuples of seven numbers; None without an area or if `straight` is not None.

    Compiled code only.
    """
    raise TypeError(f"{type(area).__name__} is no area")


@scalar_function
def has_detours(area: Area) -> bool:
    """Whether any obstacle is to be driven around; compiled code only."""
    return bool(area.detours[5] != 0.0 or area.detours[DETOUR_COLUMNS + 5] != 0.0)


def _read_bends(area: Area, straight: bool | None) -> Bends:
    at = area.detours
    return (
        (at[U(0)], at[U(1)], at[U(2)], at[U(3)], at[U(4)], at[U(5)], at[U(6)]),
        (at[U(7)], at[U(8)], at[U(9)], at[U(10)], at[U(11)], at[U(12)], at[U(13)]),
    )


@specialise(bends_of)
def _bends_of(area: Any, straight: Any) -> Callable[[Any, Any], Bends]:
    has_bends = hasattr(area, "instance_class") and isinstance(straight, types.NoneType)
    return _read_bends if has_bends else (lambda area, straight: None)


@scalar_function
def detoured(bends: Bends, place: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return x, y and forward speed of `place`, with x and y shifted by the planned detours back onto the line.

    The task thus sees the robot on its line while it drives around an obstacle as planned. Compiled code only.
    """
    if bends is None:
        return place
    x, y, forward = place
    moved_x, moved_y = _shifted(bends[0], x, y)
    more_x, more_y = _shifted(bends[1], x, y)
    return x + (moved_x + more_x), y + (moved_y + more_y), forward


@scalar_function
def _shifted(bend: Bend, x: float, y: float) -> tuple[float, float]:
    """Return by how much (x, y) one detour moves a position: most in its middle, smoothly to nothing at both ends."""
    middle_x, middle_y, along_x, along_y, per_half, left_m, aside_m = bend
    off_x, off_y = x - middle_x, y - middle_y
    along = (off_x * along_x + off_y * along_y) * per_half
    aside = abs(off_y * along_x - off_x * along_y)
    part = max(constant(1.0, x) - along * along, constant(0.0, x))
    part = part if aside < aside_m else constant(0.0, x)
    left = left_m * part * part
    return left * along_y, -left * along_x


@scalar_function
def centre_of(area: Area, place: tuple[float, float, float], cos_yaw: float, sin_yaw: float) -> tuple[float, float]:
    """Return the footprint's centre x, y (m), with the tracked point at a place; compiled code only."""
    return place[0] + area.body[CENTRE_AHEAD] * cos_yaw, place[1] + area.body[CENTRE_AHEAD] * sin_yaw


@scalar_function
def touch_reach(area: Area, forward: float) -> float:
    """Return how near (m) to a footprint's centre a shape without radius must be to cost anything; compiled only."""
    body = area.body
    corner = math.sqrt(body[HALF_LENGTH] * body[HALF_LENGTH] + body[HALF_WIDTH] * body[HALF_WIDTH])
    return corner + body[KEEP] + abs(forward) * body[STEP_LENGTH] + constant(ROUNDING_M, forward)


@scalar_function
def _off(area: Area, shape: int, time_s: float, centre: tuple[float, float]) -> tuple[float, float]:
    """Return the way x, y (m) from the nearest point of a shape's segment to a footprint's centre."""
    row, shapes = U(shape * COLUMNS), area.shapes
    off_x = centre[0] - (shapes[row] + time_s * shapes[row + U(6)])
    off_y = centre[1] - (shapes[row + U(1)] + time_s * shapes[row + U(7)])
    zero = constant(0.0, off_x)
    along = min(max(off_x * shapes[row + U(2)] + off_y * shapes[row + U(3)], zero), shapes[row + U(4)])
    return off_x - along * shapes[row + U(2)], off_y - along * shapes[row + U(3)]


@scalar_function
def is_beyond(area: Area, shape: int, time_s: float, centre: tuple[float, float], around_m: float) -> bool:
    """Whether a shape is farther than so much from a point, and surely so; compiled code only."""
    off_x, off_y = _off(area, shape, time_s, centre)
    within = around_m + area.shapes[U(shape * COLUMNS + 5)]
    return bool(off_x * off_x + off_y * off_y > within * within)


@scalar_function
def touch_cost(
    area: Area, shape: int, time_s: float, place: tuple[float, float, float], cos_yaw: float, sin_yaw: float
) -> float:
    """Cost of one shape at one step, for a robot with its tracked point there; compiled code only."""
    body, forward = area.body, place[2]
    zero = constant(0.0, forward)
    off_x, off_y = _off(area, shape, time_s, centre_of(area, place, cos_yaw, sin_yaw))
    off, inverse = norm_and_inverse(off_x, off_y)
    ahead = abs(off_x * cos_yaw + off_y * sin_yaw)
    aside = abs(off_y * cos_yaw - off_x * sin_yaw)
    towards = (body[HALF_LENGTH] * ahead + body[HALF_WIDTH] * aside) * inverse
    radius = area.shapes[U(shape * COLUMNS + 5)]
    overlap = body[KEEP] + abs(forward) * body[STEP_LENGTH] + radius + towards - off
    touches = constant(TOUCH_COST, forward) if overlap > zero else zero
    return touches + constant(TOUCH_COST_PER_M, forward) * max(overlap, zero)


@kernel_function
def touches(area: Area, paths: Floats) -> bool:
    """Whether the footprint touches a near shape on any of the paths (L, N, 3): x, y (m) from the origin, yaw (rad).

    The first pose of a path is where the plan begins, the others follow a step apart; each is looked at.
    """
    step_s = area.body[STEP_LENGTH]
    for n in range(paths.shape[0]):
        for t in range(1, paths.shape[1]):
            x, y, yaw = paths[n, t, 0], paths[n, t, 1], paths[n, t, 2]
            forward = math.hypot(x - paths[n, t - 1, 0], y - paths[n, t - 1, 1]) / step_s
            cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
            for shape in range(area.number[0]):
                if touch_cost(area, shape, t * step_s, (x, y, forward), cos_yaw, sin_yaw) > 0.0:
                    return True
    return False
