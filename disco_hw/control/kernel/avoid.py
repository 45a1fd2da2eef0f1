"""What a rollout pays for touching the fence or an obstacle: the footprint against each near shape at each step.

A shape is a capsule: a segment with a radius, which may move. A circle is one of no length, an edge of a polygon one of
no radius. The rectangle's reach towards the nearest point of the segment is subtracted from the distance, which is
exact for walls and never too far for anything convex. Every other step is looked at: between two of them no corner
comes nearer than half the way, which is kept in addition.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import Floats, U
from disco_hw.jit import kernel_function, scalar_function
from disco_hw.tasks import constant, norm_and_inverse

COLUMNS = 8
"""Of a shape: begin x, y, direction x, y, length, radius, velocity x, y (m, m/s), relative to the task's origin."""
MOST_SHAPES = 12
TOUCH_COST, TOUCH_COST_PER_M = 80.0, 800.0
"""What each look costs at which the footprint touches a shape, and each metre of overlap then."""
LOOK_EVERY = 2
"""Steps from one look to the next."""


class Area(NamedTuple):
    """What rollouts keep away from.

    `shapes` (MOST_SHAPES * COLUMNS,); `count` (1,) of them are there. `body` (5,): half the footprint's length and
    width, how far its centre lies ahead of the tracked point, the distance to keep (m), and the length of a step (s).
    `away` (MOST_SHAPES,): how far each shape is from where the plan begins (m).
    """

    shapes: Floats
    count: NDArray[np.int64]
    body: Floats
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
    area.count[0] = count


@scalar_function
def touch_cost(
    area: Area, shape: int, time_s: float, place: tuple[float, float, float], cos_yaw: float, sin_yaw: float
) -> float:
    """Cost of one shape at one step, for a robot with its tracked point there; compiled code only."""
    row, shapes, body = U(shape * COLUMNS), area.shapes, area.body
    x, y, forward = place
    zero = constant(0.0, x)
    off_x = x + body[2] * cos_yaw - (shapes[row] + time_s * shapes[row + U(6)])
    off_y = y + body[2] * sin_yaw - (shapes[row + U(1)] + time_s * shapes[row + U(7)])
    along = min(max(off_x * shapes[row + U(2)] + off_y * shapes[row + U(3)], zero), shapes[row + U(4)])
    off_x -= along * shapes[row + U(2)]
    off_y -= along * shapes[row + U(3)]
    off, inverse = norm_and_inverse(off_x, off_y)
    ahead = abs(off_x * cos_yaw + off_y * sin_yaw)
    aside = abs(off_y * cos_yaw - off_x * sin_yaw)
    overlap = (
        body[3] + abs(forward) * body[4] + shapes[row + U(5)] + (body[0] * ahead + body[1] * aside) * inverse - off
    )
    touches = constant(TOUCH_COST, x) if overlap > zero else zero
    return touches + constant(TOUCH_COST_PER_M, x) * max(overlap, zero)
