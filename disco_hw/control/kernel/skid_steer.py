"""The skid-steer robot as a system that DISCO rolls out: motion by the model's step, cost by the task.

One thread, no allocation; docs/kernel.md draws the rows of a block's state. Points that differ only in ways that leave
the axle's path alike are equivalent (`parameter_points.equivalent_points`): one rollout serves them all, and each of
them is costed. What is absent is None, in arguments of their own, as the compiler drops a branch only for those.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import (
    AHEAD0,
    AHEAD1,
    AXLE_X,
    AXLE_Y,
    BLOCK,
    BODY_REMEMBERED,
    CHANNELS,
    COLUMNS,
    COS,
    DIFFERENCE,
    FORWARD,
    FOUND,
    KEPT,
    LEFT,
    MEMORY,
    OWN,
    REMEMBERED,
    RIGHT,
    ROW,
    SCALED0,
    SCALED1,
    SIN,
    SUM,
    TOTAL,
    WHEEL_STRIDE,
    Floats,
    Terms,
    U,
    X,
    Y,
    follow,
    looks_up,
    rolls_out,
    row_of,
    stage_cost,
    terminal_cost,
)
from disco_hw.control.kernel.avoid import LOOK_EVERY, Area, Bends, bends_of, detoured, has_detours, touch_cost
from disco_hw.jit import bits_of_float, block_function, cast_like, float_from_bits, scalar_function, tune_loops
from disco_hw.model.added_terms import count_means
from disco_hw.model.coefficients import (
    MOVES_RAD_S,
    Base,
    Coefficients,
    Integration,
    base_point,
    effect_point,
    lane_base,
    lane_effects,
)
from disco_hw.model.step import (
    axle_of,
    body_step,
    delay_steps,
    in_force,
    integration_from,
    needs_change,
    tracked_of,
    wheel_step,
    wheels_follow,
)
from disco_hw.tasks import Found, constant

Absent: TypeAlias = bool | None
"""None, or anything else: whether a part is there, known to the compiler."""
Pairs: TypeAlias = NDArray[np.int64] | None
"""For each of L points the two that are equivalent to it in one way, (L, 2), or None."""
BasePair: TypeAlias = tuple[Base, Base] | None
CostPlaces: TypeAlias = tuple[np.uintp, np.uintp] | None
"""Where the costs of a pair of points begin."""
SLIDES_FROM_M, MOST_ASIDE = 0.005, 0.4
"""The least way of a step, and the largest tangent, by which the angle is taken at which a robot slides aside."""
Place: TypeAlias = tuple[float, float, float]
"""Tracked point x, y (m) and forward speed (m/s)."""


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (11,): x, y relative to the task's origin (m), cos and sin of yaw, left and right wheel speed (rad/s), time
    (s), the task's memory; how far the ground carries the robot in a step along x and y (m), in proportion to the size
    of equivalent points, and how far it slides to the left for each metre forward (`model/coefficients.py`). `slides`:
    None, or anything else if the last three count.
    `means` (L, n): what the terms of each point remember at the start, of commands first, or None where none remembers.
    `base`, `effects`: coefficient tables of L points; `each` is None, or anything else if the
    tables hold points for every sample, (L, K'). `ahead`, `scaled` (L, 2) int or None: pairs of points that
    share a point's rollout, as `parameter_points.equivalent_points` finds them. `skip_mean`: None, or anything else if
    the first point has no weight, so that it is rolled out for its equivalent points alone and its cost is left as it
    is. `series` (8,), `wide`, `euler`: how a step is integrated; under Euler steps no points share a rollout.
    `history`: rows of commands from before the plan. `wheels`: buffer of the wheels' motion, T * WHEEL_ROWS * BLOCK;
    `wheels_differ`: whether the points differ in how the wheels turn. `area`: what is kept away from, or None.
    """

    start: Floats
    slides: Absent
    means: Floats | None
    base: Base
    effects: Coefficients
    each: Absent
    ahead: Pairs
    scaled: Pairs
    skip_mean: Absent
    series: Floats
    wide: Absent
    euler: Absent
    task: Terms
    history: int
    wheels: Floats
    wheels_differ: bool
    area: Area | None = None


@block_function
def _turn_wheels(
    wheels: Floats,
    at: int,
    horizon: int,
    commands: Floats,
    state: Floats,
    start: Floats,
    means: Floats | None,
    point: int,
    effects: Coefficients,
    late: int,
    step_s: float,
) -> None:
    """Mean wheel speeds of the block's samples over every step, as rows of `wheels`."""
    tune_loops()
    for b in range(BLOCK):
        state[LEFT + b] = start[4]
        state[RIGHT + b] = start[5]
    _begin_means(means, state, REMEMBERED, point, U(0), effects.command_terms)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, step_s) * step_s
        recent = U((t + late) * CHANNELS) * BLOCK
        older = U(max(t + late - 1, 0) * CHANNELS) * BLOCK
        row, change_row = U(t) * WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
        for b in range(BLOCK):
            acting = lane_effects(effects, at + b)
            left = in_force(commands[recent + b], commands[older + b], acting)
            right = in_force(commands[recent + BLOCK + b], commands[older + BLOCK + b], acting)
            was_left, was_right = state[LEFT + b], state[RIGHT + b]
            end_left, end_right, mean_left, mean_right = wheel_step(
                left, right, was_left, was_right, time_s, acting,
                state, REMEMBERED + b, BLOCK,
            )  # fmt: skip
            state[LEFT + b] = end_left
            state[RIGHT + b] = end_right
            wheels[row + SUM + b] = mean_left + mean_right
            wheels[row + DIFFERENCE + b] = mean_right - mean_left
            if needs_change(acting):
                wheels[change_row + b] = (end_left + end_right) - (was_left + was_right)


@scalar_function
def _begin_means(means: Floats | None, state: Floats, row: int, point: int, first: int, terms: Any) -> None:
    """Set the rows from `row` on to the means of a point's terms, from number `first` on; nothing if none remembers."""
    if means is None:
        return
    for n in range(U(count_means(terms))):
        for b in range(BLOCK):
            state[row + n * BLOCK + b] = means[point, first + n]


@scalar_function
def _rolling(wheels: Floats, t: int, b: int, commands: Floats, late: int, horizon: int, effects: Coefficients) -> Place:
    """Sum of the mean wheel speeds of sample b over step t, right minus left, and the sum's change (rad/s)."""
    if wheels_follow(effects) and not needs_change(effects):
        row = U(t + late) * WHEEL_STRIDE
        left, right = commands[row + LEFT + b], commands[row + RIGHT + b]
        return left + right, right - left, cast_like(0.0, left)
    row, change_row = U(t) * WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
    return wheels[row + SUM + b], wheels[row + DIFFERENCE + b], wheels[change_row + b]


@scalar_function
def _slid(
    slides: Absent, x: float, y: float, step_x: float, step_y: float, wheel_sum: float, difference: float, start: Floats
) -> tuple[float, float]:
    """Return the position x, y after this step with the side slip and drift that the disturbance adds to the model."""
    if slides is None:
        return x, y
    # The larger of both is the sum of the wheels' sizes.
    turned = max(abs(wheel_sum), abs(difference)) * constant(1.0 / MOVES_RAD_S, x)
    carried = min(turned, constant(1.0, x))
    return x + (carried * start[8] - start[10] * step_y), y + (carried * start[9] + start[10] * step_x)


@scalar_function
def _move(
    state: Floats, b: int, rolling: Place, time_s: float, base: Base, effects: Coefficients, integration: Integration,
    slides: Absent, start: Floats,
) -> None:  # fmt: skip
    """Move sample b on by one step."""
    wheel_sum, difference, change = rolling
    axle_x, axle_y, cos_yaw, sin_yaw, forward, _ = body_step(
        state[AXLE_X + b], state[AXLE_Y + b], state[COS + b], state[SIN + b],
        wheel_sum, difference, change, time_s, base, effects, integration,
        state, BODY_REMEMBERED + b, BLOCK,
    )  # fmt: skip
    step_x, step_y = axle_x - state[AXLE_X + b], axle_y - state[AXLE_Y + b]
    axle_x, axle_y = _slid(slides, axle_x, axle_y, step_x, step_y, wheel_sum, difference, start)
    state[AXLE_X + b] = axle_x
    state[AXLE_Y + b] = axle_y
    state[COS + b] = cos_yaw
    state[SIN + b] = sin_yaw
    state[FORWARD + b] = forward


@scalar_function
def _begin(state: Floats, own: int, b: int, start: Floats, task: Terms, bends: Bends) -> None:
    """Set the rows from `own` on to the start."""
    x, y, _ = detoured(bends, (start[0], start[1], start[0]))
    state[own + X + b] = x
    state[own + Y + b] = y
    state[own + MEMORY + b] = start[7]
    state[own + TOTAL + b] = cast_like(0.0, start[0])
    _remember(looks_up(task), state, own, b, start[7], task)


@scalar_function
def _found(looks: Absent, state: Floats, own: int, b: int) -> Found:
    """Return what sample b has kept and found in the task's table, in the rows from `own` on; zeros without one."""
    if looks is None:
        zero = cast_like(0.0, state[own])
        return zero, zero, zero, zero, zero
    at = own + FOUND + COLUMNS * b
    return state[own + KEPT + b], state[at], state[at + U(1)], state[at + U(2)], state[at + U(3)]


@scalar_function
def _remember(looks: Absent, state: Floats, own: int, b: int, memory: float, task: Terms) -> None:
    """Set the memory of sample b, and where to look up for it, in bits; nothing without a table."""
    if looks is None:
        return
    state[own + MEMORY + b] = memory
    state[own + ROW + b] = float_from_bits(row_of(task, memory))


@scalar_function
def _follow(looks: Absent, state: Floats, own: int, b: int, place: Place, task: Terms) -> None:
    """Move the memory of sample b on by the step that it has just made; nothing without a table."""
    if looks is None:
        return
    x, y, forward = place
    found = _found(looks, state, own, b)
    memory, state[own + KEPT + b] = follow(task, state[own + MEMORY + b], x, y, forward, found)
    _remember(looks, state, own, b, memory, task)


@scalar_function
def _look_up(table: Floats, state: Floats, own: int) -> None:
    """Copy every sample's row of the table to the rows from `own` on: apart, as no compiler makes vectors of it.

    A sample's four numbers stay together, and are all read before the first is written: one load and one store.
    """
    for b in range(BLOCK):
        row, at = COLUMNS * U(bits_of_float(state[own + ROW + b])), own + FOUND + COLUMNS * b
        first, second, third, fourth = table[row], table[row + U(1)], table[row + U(2)], table[row + U(3)]
        state[at] = first
        state[at + U(1)] = second
        state[at + U(2)] = third
        state[at + U(3)] = fourth


@scalar_function
def _look_ups(looks: Absent, state: Floats, skip_mean: Absent, ahead: BasePair, scaled: BasePair, task: Terms) -> None:
    """Look up for a point and its equivalent points; nothing without a table."""
    if looks is None:
        return
    table = task.table
    if skip_mean is None:
        _look_up(table, state, OWN)
    if ahead is not None:
        _look_up(table, state, AHEAD0)
        _look_up(table, state, AHEAD1)
    if scaled is not None:
        _look_up(table, state, SCALED0)
        _look_up(table, state, SCALED1)


@scalar_function
def _cost(state: Floats, own: int, b: int, t: int, place: Place, task: Terms, last: Absent) -> None:
    """Add the cost of step t, which sample b has just made, to the rows from `own` on; `last` is None before it."""
    cos_yaw, sin_yaw = state[COS + b], state[SIN + b]
    x, y, forward = place
    cost, memory = stage_cost(
        task, state[own + MEMORY + b], t, state[own + X + b], state[own + Y + b], x, y, cos_yaw, sin_yaw, forward,
        _found(looks_up(task), state, own, b),
    )  # fmt: skip
    state[own + TOTAL + b] += cost
    if looks_up(task) is None:
        state[own + MEMORY + b] = memory
    if looks_up(task) is None or last is not None:
        state[own + X + b] = x
        state[own + Y + b] = y


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
    return x - farther * (state[COS + b] - start[2]), y - farther * (state[SIN + b] - start[3]), forward


@scalar_function
def _scaled_place(state: Floats, b: int, base: Base, other: Base, start: Floats) -> Place:
    """Return the place for a point equivalent to `base` whose path is the same at another scale."""
    scale = other.half_radius_m / base.half_radius_m
    ahead, stays = other.x_icr_m - scale * base.x_icr_m, cast_like(1.0, scale) - scale
    axle_x = scale * state[AXLE_X + b] + (stays * start[0] + ahead * start[2])
    axle_y = scale * state[AXLE_Y + b] + (stays * start[1] + ahead * start[3])
    x, y = tracked_of(axle_x, axle_y, state[COS + b], state[SIN + b], other)
    return x, y, scale * state[FORWARD + b]


@scalar_function
def _follows(
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
        _follow(looks, state, OWN, b, detoured(bends, _place(state, b, base)), task)
    if ahead is not None:
        _follow(looks, state, AHEAD0, b, detoured(bends, _ahead_place(state, b, base, ahead[0], start)), task)
        _follow(looks, state, AHEAD1, b, detoured(bends, _ahead_place(state, b, base, ahead[1], start)), task)
    if scaled is not None:
        _follow(looks, state, SCALED0, b, detoured(bends, _scaled_place(state, b, base, scaled[0], start)), task)
        _follow(looks, state, SCALED1, b, detoured(bends, _scaled_place(state, b, base, scaled[1], start)), task)


@scalar_function
def _costs(
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
        _cost(state, OWN, b, t, detoured(bends, _place(state, b, base)), task, last)
    if ahead is not None:
        _cost(state, AHEAD0, b, t, detoured(bends, _ahead_place(state, b, base, ahead[0], start)), task, last)
        _cost(state, AHEAD1, b, t, detoured(bends, _ahead_place(state, b, base, ahead[1], start)), task, last)
    if scaled is not None:
        _cost(state, SCALED0, b, t, detoured(bends, _scaled_place(state, b, base, scaled[0], start)), task, last)
        _cost(state, SCALED1, b, t, detoured(bends, _scaled_place(state, b, base, scaled[1], start)), task, last)


@scalar_function
def _avoid(
    area: Area | None, state: Floats, at: int, t: int, base: Base, skip_mean: Absent, ahead: BasePair,
    scaled: BasePair, start: Floats,
) -> None:  # fmt: skip
    """Add what step t, which the block has just made, costs for touching a shape; nothing without an area."""
    if area is None:
        return
    time_s = cast_like(t + 1, start[0]) * area.body[4]
    reach_m = area.body[6] + area.body[5] * time_s
    for k in range(area.number[0]):
        if area.away[k] > reach_m:
            continue
        if skip_mean is None:
            for b in range(BLOCK):
                place = _place(state, b, lane_base(base, at + b))
                state[OWN + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])
        if ahead is not None:
            for b in range(BLOCK):
                place = _ahead_place(state, b, base, ahead[0], start)
                state[AHEAD0 + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])
            for b in range(BLOCK):
                place = _ahead_place(state, b, base, ahead[1], start)
                state[AHEAD1 + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])
        if scaled is not None:
            for b in range(BLOCK):
                place = _scaled_place(state, b, base, scaled[0], start)
                state[SCALED0 + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])
            for b in range(BLOCK):
                place = _scaled_place(state, b, base, scaled[1], start)
                state[SCALED1 + TOTAL + b] += touch_cost(area, k, time_s, place, state[COS + b], state[SIN + b])


@scalar_function
def sliding_heading(
    slides: Absent, cos_yaw: float, sin_yaw: float, forward_m: float, start: Floats
) -> tuple[float, float]:
    """Heading of an undisturbed robot that would go where this one slides to, which goes so far forward in a step."""
    if slides is None:
        return cos_yaw, sin_yaw
    one = constant(1.0, forward_m)
    way = max(forward_m, constant(SLIDES_FROM_M, forward_m))
    aside = start[10] + (cos_yaw * start[9] - sin_yaw * start[8]) / way
    aside = min(max(aside, -constant(MOST_ASIDE, forward_m)), constant(MOST_ASIDE, forward_m))
    scale = one / math.sqrt(one + aside * aside)
    return (cos_yaw - aside * sin_yaw) * scale, (sin_yaw + aside * cos_yaw) * scale


@block_function
def _end(
    costs: Floats, at: int, state: Floats, own: int, slides: Absent, start: Floats, step_s: float, task: Terms
) -> None:
    """Write the costs of the rows from `own` on to `costs[at:at + BLOCK]`."""
    tune_loops()
    for b in range(BLOCK):
        cos_yaw, sin_yaw = sliding_heading(slides, state[COS + b], state[SIN + b], state[FORWARD + b] * step_s, start)
        costs[at + b] = state[own + TOTAL + b] + terminal_cost(
            task, state[own + MEMORY + b], state[own + X + b], state[own + Y + b], cos_yaw, sin_yaw,
            _found(looks_up(task), state, own, b),
        )  # fmt: skip


@block_function
def _roll(
    costs: Floats, at: int, ahead_at: CostPlaces, scaled_at: CostPlaces, horizon: int, commands: Floats, late: int,
    wheels: Floats, state: Floats, slides: Absent, start: Floats, means: Floats | None, point: int, base: Base,
    skip_mean: Absent, ahead: BasePair, scaled: BasePair, effects: Coefficients, integration: Integration, task: Terms,
    area: Area | None, straight: Absent,
) -> None:  # fmt: skip
    """Roll the block out from `start` with its wheels turning as in `wheels`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples. Equivalent
    points, the pairs `ahead` and `scaled` or None, are costed along with it, at `ahead_at` and `scaled_at`; they alone,
    where `skip_mean` is not None. A step is costed together with the next one's motion: neither waits for the other,
    which saves a sixth of the time.
    """
    tune_loops()
    bends = bends_of(area, straight)
    x, y, cos_yaw, sin_yaw = start[0], start[1], start[2], start[3]
    for b in range(BLOCK):
        state[AXLE_X + b], state[AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, lane_base(base, at + b))
        state[COS + b] = cos_yaw
        state[SIN + b] = sin_yaw
        if skip_mean is None:
            _begin(state, OWN, b, start, task, bends)
        _begin(state, AHEAD0, b, start, task, bends)
        _begin(state, AHEAD1, b, start, task, bends)
        _begin(state, SCALED0, b, start, task, bends)
        _begin(state, SCALED1, b, start, task, bends)
    _begin_means(means, state, BODY_REMEMBERED, point, U(count_means(effects.command_terms)), effects.body_terms)
    _look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, x) * integration.step_s
        if t == 0:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _move(
                    state, b, _rolling(wheels, t, b, commands, late, horizon, acting), time_s, here, acting,
                    integration, slides, start,
                )  # fmt: skip
                _follows(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task, bends)
        else:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _costs(state, b, t - 1, here, skip_mean, ahead, scaled, start, task, None, bends)
                _move(
                    state, b, _rolling(wheels, t, b, commands, late, horizon, acting), time_s, here, acting,
                    integration, slides, start,
                )  # fmt: skip
                _follows(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task, bends)
        _look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
        if t % LOOK_EVERY == LOOK_EVERY - 1:
            _avoid(area, state, at, t, base, skip_mean, ahead, scaled, start)
    for b in range(BLOCK):
        _costs(state, b, horizon - 1, lane_base(base, at + b), skip_mean, ahead, scaled, start, task, True, bends)
    # One after the other: a loop that wrote to all at once would not be vectorised.
    if skip_mean is None:
        _end(costs, at, state, OWN, slides, start, integration.step_s, task)
    if ahead_at is not None:
        _end(costs, ahead_at[0], state, AHEAD0, slides, start, integration.step_s, task)
        _end(costs, ahead_at[1], state, AHEAD1, slides, start, integration.step_s, task)
    if scaled_at is not None:
        _end(costs, scaled_at[0], state, SCALED0, slides, start, integration.step_s, task)
        _end(costs, scaled_at[1], state, SCALED1, slides, start, integration.step_s, task)


@scalar_function
def _bases(base: Base, pair: NDArray[np.int64]) -> tuple[Base, Base]:
    """Return base coefficients of a pair of points."""
    return base_point(base, pair[0]), base_point(base, pair[1])


@scalar_function
def _places(pair: NDArray[np.int64], padded: int, lane: np.uintp) -> CostPlaces:
    """Return the indices at which the costs of a pair of points begin."""
    return U(pair[0] * padded) + lane, U(pair[1] * padded) + lane


@block_function
def _roll_points(
    each: Absent, skip_mean: Absent, ahead: Pairs, scaled: Pairs, system: SkidSteer, costs: Floats, points: int,
    padded: int, block: int, horizon: int, commands: Floats, state: Floats, straight: Absent,
) -> None:  # fmt: skip
    integration = integration_from(system.series, system.wide, system.euler)
    slides, start, means = system.slides, system.start, system.means
    wheels, task = system.wheels, system.task
    lane = U(block) * BLOCK
    for i in range(points):
        at = U(i * padded) + lane
        here, acting = base_point(system.base, i), effect_point(system.effects, i)
        late = system.history - delay_steps(acting)
        if each is not None:
            if needs_change(acting) or not wheels_follow(acting):
                _turn_wheels(
                    wheels, at, horizon, commands, state, start, means, i, system.effects, late, integration.step_s
                )
            _roll(
                costs, at, None, None, horizon, commands, late, wheels, state, slides, start, means, i, system.base,
                None, None, None, system.effects, integration, task, system.area, straight,
            )  # fmt: skip
        else:
            if (i == 0 or system.wheels_differ) and (needs_change(acting) or not wheels_follow(acting)):
                _turn_wheels(wheels, at, horizon, commands, state, start, means, i, acting, late, integration.step_s)
            alone = i > 0 or skip_mean is None
            if ahead is not None:
                # Whatever leads equivalent points beside the first point is costed in a rollout of its own.
                alone = alone and (ahead[i, 0] == -1 or (skip_mean is not None and ahead[i, 0] >= 0))
                if ahead[i, 0] >= 0:
                    if scaled is None:
                        _roll(
                            costs, at, _places(ahead[i], padded, lane), None, horizon, commands, late, wheels, state,
                            slides, start, means, i, here, skip_mean, _bases(system.base, ahead[i]), None, acting,
                            integration, task, system.area, straight,
                        )  # fmt: skip
                    else:
                        _roll(
                            costs, at, _places(ahead[i], padded, lane), _places(scaled[i], padded, lane), horizon,
                            commands, late, wheels, state, slides, start, means, i, here, skip_mean,
                            _bases(system.base, ahead[i]), _bases(system.base, scaled[i]), acting, integration, task,
                            system.area, straight,
                        )  # fmt: skip
            if alone:
                _roll(
                    costs, at, None, None, horizon, commands, late, wheels, state, slides, start, means, i, here, None,
                    None, None, acting, integration, task,
                            system.area, straight,
                )  # fmt: skip


@block_function
def _roll_all(
    area: Area | None, system: SkidSteer, costs: Floats, points: int, padded: int, block: int, horizon: int,
    commands: Floats, state: Floats,
) -> None:  # fmt: skip
    """Roll out with detours or straight on, which is two functions: detours cost a third of the time even if empty."""
    if area is None:
        _roll_points(
            system.each, system.skip_mean, system.ahead, system.scaled, system, costs, points, padded, block, horizon,
            commands, state, None,
        )  # fmt: skip
        return
    if has_detours(area):
        _roll_points(
            system.each, system.skip_mean, system.ahead, system.scaled, system, costs, points, padded, block, horizon,
            commands, state, None,
        )  # fmt: skip
    else:
        _roll_points(
            system.each, system.skip_mean, system.ahead, system.scaled, system, costs, points, padded, block, horizon,
            commands, state, True,
        )  # fmt: skip


@rolls_out(SkidSteer)
def roll_skid_steer(
    system: SkidSteer, costs: Floats, points: int, padded: int, block: int, horizon: int, commands: Floats,
    state: Floats,
) -> None:  # fmt: skip
    """Costs of one block of samples under all parameter points; see `roll_block`."""
    _roll_all(system.area, system, costs, points, padded, block, horizon, commands, state)
