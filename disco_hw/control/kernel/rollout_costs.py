"""Costs of a rollout, in the rows of a block's state: of a point and of the points that are equivalent to it.

An equivalent point has the same axle's path, or the same at another scale: it has a tracked point, memory and cost of
its own, in ten rows of its own (docs/kernel.md draws them). Pairs of points that are absent are None.
"""

from __future__ import annotations

import math
from typing import TypeAlias

from disco_hw.control.kernel import (
    AHEAD0,
    AHEAD1,
    AXLE_X,
    AXLE_Y,
    BLOCK,
    COLUMNS,
    COS,
    FORWARD,
    FOUND,
    KEPT,
    MEMORY,
    POINT,
    ROW,
    SCALED0,
    SCALED1,
    SIN,
    START_COS,
    START_MEMORY,
    START_SIN,
    START_X,
    START_Y,
    TOTAL,
    Floats,
    Terms,
    U,
    X,
    Y,
    follow,
    looks_up,
    row_of,
    stage_cost,
    terminal_cost,
)
from disco_hw.control.kernel.avoid import (
    FASTEST,
    REACH,
    STEP_LENGTH,
    Area,
    Bends,
    centre_of,
    detoured,
    is_beyond,
    touch_cost,
    touch_reach,
)
from disco_hw.jit import bits_of_float, block_function, cast_like, float_from_bits, int32, scalar_function, tune_loops
from disco_hw.model.coefficients import Base, lane_base
from disco_hw.model.step import tracked_of
from disco_hw.tasks import Found

Absent: TypeAlias = bool | None
"""None, or anything else: whether a part is there, known to the compiler."""
BasePair: TypeAlias = tuple[Base, Base] | None
"""Return base coefficients of a pair of points."""
Place: TypeAlias = tuple[float, float, float]
"""Tracked point x, y (m) and forward speed (m/s)."""


@scalar_function
def _place(state: Floats, b: int, base: Base) -> Place:
    """Tracked point of sample b and forward speed over its last step, under the point `base`."""
    x, y = tracked_of(state[AXLE_X + b], state[AXLE_Y + b], state[COS + b], state[SIN + b], base)
    return x, y, state[FORWARD + b]


@scalar_function
def _ahead_place(state: Floats, b: int, base: Base, other: Base, start: Floats) -> Place:
    """Return the place for a point equivalent to `base` that differs in x_icr: it turns about the same axle."""
    x, y, forward = _place(state, b, base)
    farther = other.x_icr_m - base.x_icr_m
    return x - farther * (state[COS + b] - start[START_COS]), y - farther * (state[SIN + b] - start[START_SIN]), forward


@scalar_function
def _scaled_place(state: Floats, b: int, base: Base, other: Base, start: Floats) -> Place:
    """Return the place for a point equivalent to `base` whose path is the same at another scale."""
    scale = other.half_radius_m / base.half_radius_m
    ahead, stays = other.x_icr_m - scale * base.x_icr_m, cast_like(1.0, scale) - scale
    axle_x = scale * state[AXLE_X + b] + (stays * start[START_X] + ahead * start[START_COS])
    axle_y = scale * state[AXLE_Y + b] + (stays * start[START_Y] + ahead * start[START_SIN])
    x, y = tracked_of(axle_x, axle_y, state[COS + b], state[SIN + b], other)
    return x, y, scale * state[FORWARD + b]


@scalar_function
def begin_costs(state: Floats, point: int, b: int, start: Floats, task: Terms, bends: Bends) -> None:
    """Set the rows from `point` on to the start."""
    x, y, _ = detoured(bends, (start[START_X], start[START_Y], start[START_X]))
    state[point + X + b] = x
    state[point + Y + b] = y
    state[point + MEMORY + b] = start[START_MEMORY]
    state[point + TOTAL + b] = cast_like(0.0, start[START_X])
    _store_memory(looks_up(task), state, point, b, start[START_MEMORY], task)


@scalar_function
def _found(looks: Absent, state: Floats, point: int, b: int) -> Found:
    """Return what sample b has kept and found in the task's table, in the rows from `point` on; zeros without one."""
    if looks is None:
        zero = cast_like(0.0, state[point])
        return zero, zero, zero, zero, zero
    at = point + FOUND + COLUMNS * b
    return state[point + KEPT + b], state[at], state[at + U(1)], state[at + U(2)], state[at + U(3)]


@scalar_function
def _store_memory(looks: Absent, state: Floats, point: int, b: int, memory: float, task: Terms) -> None:
    """Set the memory of sample b, and where to look up for it, in bits; nothing without a table."""
    if looks is None:
        return
    state[point + MEMORY + b] = memory
    state[point + ROW + b] = float_from_bits(row_of(task, memory))


@scalar_function
def _follow(looks: Absent, state: Floats, point: int, b: int, place: Place, task: Terms) -> None:
    """Move the memory of sample b on by the step that it has just made; nothing without a table."""
    if looks is None:
        return
    x, y, forward = place
    found = _found(looks, state, point, b)
    memory, state[point + KEPT + b] = follow(task, state[point + MEMORY + b], x, y, forward, found)
    _store_memory(looks, state, point, b, memory, task)


@scalar_function
def follow_points(
    looks: Absent,
    state: Floats,
    b: int,
    base: Base,
    skip_mean: Absent,
    ahead: BasePair,
    scaled: BasePair,
    start: Floats,
    task: Terms,
    bends: Bends,
) -> None:
    """Move the memories of a point and its equivalent points on; nothing without a table."""
    if looks is None:
        return
    if skip_mean is None:
        _follow(looks, state, POINT, b, detoured(bends, _place(state, b, base)), task)
    if ahead is not None:
        _follow(looks, state, AHEAD0, b, detoured(bends, _ahead_place(state, b, base, ahead[0], start)), task)
        _follow(looks, state, AHEAD1, b, detoured(bends, _ahead_place(state, b, base, ahead[1], start)), task)
    if scaled is not None:
        _follow(looks, state, SCALED0, b, detoured(bends, _scaled_place(state, b, base, scaled[0], start)), task)
        _follow(looks, state, SCALED1, b, detoured(bends, _scaled_place(state, b, base, scaled[1], start)), task)


@scalar_function
def _look_up(table: Floats, state: Floats, point: int) -> None:
    """Copy every sample's row of the table to the rows from `point` on: apart, as no compiler makes vectors of it.

    A sample's four numbers stay together, and are all read before the first is written: one load and one store.
    """
    for b in range(BLOCK):
        row, at = COLUMNS * U(bits_of_float(state[point + ROW + b])), point + FOUND + COLUMNS * b
        first, second, third, fourth = table[row], table[row + U(1)], table[row + U(2)], table[row + U(3)]
        state[at] = first
        state[at + U(1)] = second
        state[at + U(2)] = third
        state[at + U(3)] = fourth


@scalar_function
def look_ups(looks: Absent, state: Floats, skip_mean: Absent, ahead: BasePair, scaled: BasePair, task: Terms) -> None:
    """Look up for a point and its equivalent points; nothing without a table."""
    if looks is None:
        return
    table = task.table
    if skip_mean is None:
        _look_up(table, state, POINT)
    if ahead is not None:
        _look_up(table, state, AHEAD0)
        _look_up(table, state, AHEAD1)
    if scaled is not None:
        _look_up(table, state, SCALED0)
        _look_up(table, state, SCALED1)


@scalar_function
def _cost(state: Floats, point: int, b: int, t: int, place: Place, task: Terms, last: Absent) -> None:
    """Add the cost of step t, which sample b has just made, to the rows from `point` on; `last` is None before it."""
    cos_yaw, sin_yaw = state[COS + b], state[SIN + b]
    x, y, forward = place
    cost, memory = stage_cost(
        task, state[point + MEMORY + b], t, state[point + X + b], state[point + Y + b], x, y, cos_yaw, sin_yaw, forward,
        _found(looks_up(task), state, point, b),
    )  # fmt: skip
    state[point + TOTAL + b] += cost
    if looks_up(task) is None:
        state[point + MEMORY + b] = memory
    if looks_up(task) is None or last is not None:
        state[point + X + b] = x
        state[point + Y + b] = y


@scalar_function
def add_costs(
    state: Floats,
    b: int,
    t: int,
    base: Base,
    skip_mean: Absent,
    ahead: BasePair,
    scaled: BasePair,
    start: Floats,
    task: Terms,
    last: Absent,
    bends: Bends,
) -> None:
    """Costs of step t under a point and its equivalent points, pairs or None."""
    if skip_mean is None:
        _cost(state, POINT, b, t, detoured(bends, _place(state, b, base)), task, last)
    if ahead is not None:
        _cost(state, AHEAD0, b, t, detoured(bends, _ahead_place(state, b, base, ahead[0], start)), task, last)
        _cost(state, AHEAD1, b, t, detoured(bends, _ahead_place(state, b, base, ahead[1], start)), task, last)
    if scaled is not None:
        _cost(state, SCALED0, b, t, detoured(bends, _scaled_place(state, b, base, scaled[0], start)), task, last)
        _cost(state, SCALED1, b, t, detoured(bends, _scaled_place(state, b, base, scaled[1], start)), task, last)


@scalar_function
def avoid_shapes(
    area: Area | None, state: Floats, at: int, t: int, base: Base, skip_mean: Absent, ahead: BasePair,
    scaled: BasePair, start: Floats,
) -> None:  # fmt: skip
    """Add what step t, which the block has just made, costs for touching a shape; nothing without an area."""
    if area is None:
        return
    time_s = cast_like(t + 1, start[START_X]) * area.body[STEP_LENGTH]
    # Where a plan can be by now, there is often nothing: then no sample is looked at.
    reach_m = area.body[REACH] + area.body[FASTEST] * time_s
    near = False
    for k in range(area.number[0]):
        near |= area.away[k] <= reach_m
    if not near:
        return
    if skip_mean is None:
        _avoid(area, state, POINT, at, time_s, reach_m, base, None, None, start)
    if ahead is not None:
        _avoid(area, state, AHEAD0, at, time_s, reach_m, base, ahead[0], None, start)
        _avoid(area, state, AHEAD1, at, time_s, reach_m, base, ahead[1], None, start)
    if scaled is not None:
        _avoid(area, state, SCALED0, at, time_s, reach_m, base, scaled[0], True, start)
        _avoid(area, state, SCALED1, at, time_s, reach_m, base, scaled[1], True, start)


@scalar_function
def _avoid(
    area: Area, state: Floats, point: int, at: int, time_s: float, reach_m: float, base: Base, other: Base | None,
    is_scaled: Absent, start: Floats,
) -> None:  # fmt: skip
    """Add the cost of touching shapes to the rows from `point` on, for shapes that a circle around all samples meets.

    Sizes are compared by their bits, in which numbers of zero or more have the same order, as the compiler makes
    vectors of a maximum of integers only.
    """
    first = _any_place(state, U(0), lane_base(base, at), other, is_scaled, start)
    middle = centre_of(area, first, state[COS], state[SIN])
    farthest, fastest = int32(0), int32(0)
    for b in range(BLOCK):
        place = _any_place(state, b, lane_base(base, at + b), other, is_scaled, start)
        x, y = centre_of(area, place, state[COS + b], state[SIN + b])
        off_x, off_y = x - middle[0], y - middle[1]
        farthest = max(farthest, bits_of_float(off_x * off_x + off_y * off_y))
        fastest = max(fastest, bits_of_float(abs(place[2])))
    around_m = math.sqrt(float_from_bits(farthest)) + touch_reach(area, float_from_bits(fastest))
    for k in range(area.number[0]):
        if area.away[k] > reach_m or is_beyond(area, k, time_s, middle, around_m):
            continue
        for b in range(BLOCK):
            place = _any_place(state, b, lane_base(base, at + b), other, is_scaled, start)
            state[point + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])


@scalar_function
def _any_place(
    state: Floats, b: int, base: Base, other: Base | None, is_scaled: Absent, start: Floats
) -> Place:  # fmt: skip
    """Return the place of sample b under `base`, or under the `other` point that is equivalent to it."""
    if other is None:
        return _place(state, b, base)
    if is_scaled is None:
        return _ahead_place(state, b, base, other, start)
    return _scaled_place(state, b, base, other, start)


@block_function
def end_costs(costs: Floats, at: int, state: Floats, point: int, task: Terms) -> None:
    """Write the costs of the rows from `point` on to `costs[at:at + BLOCK]`."""
    tune_loops()
    for b in range(BLOCK):
        costs[at + b] = state[point + TOTAL + b] + terminal_cost(
            task, state[point + MEMORY + b], state[point + X + b], state[point + Y + b], state[COS + b],
            state[SIN + b], _found(looks_up(task), state, point, b),
        )  # fmt: skip
