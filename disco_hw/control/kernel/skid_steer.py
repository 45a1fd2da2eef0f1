"""The skid-steer robot as a system that DISCO rolls out: motion by the model's step, cost by the task.

One thread, no allocation. Samples are the innermost dimension everywhere, in blocks of fixed size, so that every loop
over them vectorises without a remainder and a block's commands and states stay in the first-level cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from disco_hw.control.kernel.blocks import BLOCK, U
from disco_hw.control.kernel.rollout import roll_block
from disco_hw.control.kernel.task_costs import follow, looks_up, row_of, stage_cost, terminal_cost
from disco_hw.jit import (
    bits_of_float,
    block_function,
    cast_like,
    float_from_bits,
    scalar_function,
    specialise,
    tune_loops,
)
from disco_hw.model.compose import delay_steps, in_force, needs_change, wheels_follow
from disco_hw.model.step import axle_of, body_step, integration_from, tracked_of, wheel_step
from disco_hw.model.tables import base_point, effect_point, lane_base, lane_effects

# Rows of a block's state; one flat buffer at fixed offsets spares the compiler all checks for overlap. Five sets of
# rows for what differs between points that share the axle's motion.
_AXLE_X, _AXLE_Y, _COS, _SIN, _FORWARD = (U(row) * BLOCK for row in range(5))
_LEFT, _RIGHT = U(0) * BLOCK, BLOCK
_OWN, _TWIN0, _TWIN1, _TWIN2, _TWIN3 = (U(row) * BLOCK for row in (5, 15, 25, 35, 45))
_X, _Y, _MEMORY, _TOTAL, _KEPT, _ROW, _FOUND = (U(row) * BLOCK for row in range(7))
_COLUMNS = U(4)
_CHANNELS = 2
# The wheels' motion: for every step a row of their sum and one of right minus left; then a row of the sum's change.
_SUM, _DIFFERENCE = U(0) * BLOCK, BLOCK
_WHEEL_STRIDE = U(2) * BLOCK
WHEEL_ROWS = 3


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (8,): x, y relative to the task's origin (m), cos and sin of yaw, left and right wheel speed (rad/s), time
    (s), the task's memory. `base`, `effects`: coefficient tables of L points; `each` is None, or anything else if the
    tables hold points for every sample, (L, K'). `ahead`, `scaled` (L, 2) int or None: pairs of points that
    share a point's rollout, as `parameter_points.equivalent_points` finds them. `skip_mean`: None, or anything else if
    the first point has no weight, so that it is rolled out for its twins alone and its cost is left as it is. `series`
    (8,), `wide`: how a step is integrated.
    `history`: rows of commands from before the plan. `wheels`: buffer of the wheels' motion, T * WHEEL_ROWS * BLOCK;
    `wheels_differ`: whether the points differ in how the wheels turn.
    """

    start: Any
    base: Any
    effects: Any
    each: Any
    ahead: Any
    scaled: Any
    skip_mean: Any
    series: Any
    wide: Any
    task: Any
    history: Any
    wheels: Any
    wheels_differ: Any


@block_function
def _turn_wheels(
    wheels: Any, at: Any, horizon: int, commands: Any, state: Any, start: Any, effects: Any, late: int, step_s: float
) -> None:
    """Mean wheel speeds of the block's samples over every step, as rows of `wheels`."""
    tune_loops()
    for b in range(BLOCK):
        state[_LEFT + b] = start[4]
        state[_RIGHT + b] = start[5]
    for t in range(horizon):
        time_s = start[6] + cast_like(t, step_s) * step_s
        recent = U((t + late) * _CHANNELS) * BLOCK
        older = U(max(t + late - 1, 0) * _CHANNELS) * BLOCK
        row, change_row = U(t) * _WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
        for b in range(BLOCK):
            acting = lane_effects(effects, at + b)
            left = in_force(commands[recent + b], commands[older + b], acting)
            right = in_force(commands[recent + BLOCK + b], commands[older + BLOCK + b], acting)
            was_left, was_right = state[_LEFT + b], state[_RIGHT + b]
            end_left, end_right, mean_left, mean_right = wheel_step(left, right, was_left, was_right, time_s, acting)
            state[_LEFT + b] = end_left
            state[_RIGHT + b] = end_right
            wheels[row + _SUM + b] = mean_left + mean_right
            wheels[row + _DIFFERENCE + b] = mean_right - mean_left
            if needs_change(acting):
                wheels[change_row + b] = (end_left + end_right) - (was_left + was_right)


@scalar_function
def _rolling(wheels: Any, t: int, b: Any, commands: Any, late: int, horizon: int, effects: Any) -> Any:
    """Sum of the mean wheel speeds of sample b over step t, right minus left, and the sum's change (rad/s)."""
    if wheels_follow(effects) and not needs_change(effects):
        row = U(t + late) * _WHEEL_STRIDE
        left, right = commands[row + _LEFT + b], commands[row + _RIGHT + b]
        return left + right, right - left, cast_like(0.0, left)
    row, change_row = U(t) * _WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
    return wheels[row + _SUM + b], wheels[row + _DIFFERENCE + b], wheels[change_row + b]


@scalar_function
def _move(state: Any, b: Any, rolling: Any, time_s: Any, base: Any, effects: Any, integration: Any) -> None:
    """Move sample b on by one step."""
    wheel_sum, difference, change = rolling
    axle_x, axle_y, cos_yaw, sin_yaw, forward, _ = body_step(
        state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b],
        wheel_sum, difference, change, time_s, base, effects, integration,
    )  # fmt: skip
    state[_AXLE_X + b] = axle_x
    state[_AXLE_Y + b] = axle_y
    state[_COS + b] = cos_yaw
    state[_SIN + b] = sin_yaw
    state[_FORWARD + b] = forward


@scalar_function
def _begin(state: Any, own: Any, b: Any, start: Any, task: Any) -> None:
    """Set the rows from `own` on to the start."""
    state[own + _X + b] = start[0]
    state[own + _Y + b] = start[1]
    state[own + _MEMORY + b] = start[7]
    state[own + _TOTAL + b] = cast_like(0.0, start[0])
    _remember(looks_up(task), state, own, b, start[7], task)


@scalar_function
def _found(looks: Any, state: Any, own: Any, b: Any) -> Any:
    """What sample b has kept and found in the task's table, in the rows from `own` on; zeros without a table."""
    if looks is None:
        zero = cast_like(0.0, state[own])
        return zero, zero, zero, zero, zero
    at = own + _FOUND + _COLUMNS * b
    return state[own + _KEPT + b], state[at], state[at + U(1)], state[at + U(2)], state[at + U(3)]


@scalar_function
def _remember(looks: Any, state: Any, own: Any, b: Any, memory: Any, task: Any) -> None:
    """Set the memory of sample b, and where to look up for it, in bits; nothing without a table."""
    if looks is None:
        return
    state[own + _MEMORY + b] = memory
    state[own + _ROW + b] = float_from_bits(row_of(task, memory))


@scalar_function
def _follow(looks: Any, state: Any, own: Any, b: Any, place: Any, task: Any) -> None:
    """Move the memory of sample b on by the step that it has just made; nothing without a table."""
    if looks is None:
        return
    x, y, forward = place
    found = _found(looks, state, own, b)
    memory, state[own + _KEPT + b] = follow(task, state[own + _MEMORY + b], x, y, forward, found)
    _remember(looks, state, own, b, memory, task)


@scalar_function
def _look_up(table: Any, state: Any, own: Any) -> None:
    """Copy every sample's row of the table to the rows from `own` on: apart, as no compiler makes vectors of it.

    A sample's four numbers stay together, and are all read before the first is written: one load and one store.
    """
    for b in range(BLOCK):
        row, at = _COLUMNS * U(bits_of_float(state[own + _ROW + b])), own + _FOUND + _COLUMNS * b
        first, second, third, fourth = table[row], table[row + U(1)], table[row + U(2)], table[row + U(3)]
        state[at] = first
        state[at + U(1)] = second
        state[at + U(2)] = third
        state[at + U(3)] = fourth


@scalar_function
def _look_ups(looks: Any, state: Any, skip_mean: Any, ahead: Any, scaled: Any, task: Any) -> None:
    """Look up for a point and its twins; nothing without a table."""
    if looks is None:
        return
    table = task.table
    if skip_mean is None:
        _look_up(table, state, _OWN)
    if ahead is not None:
        _look_up(table, state, _TWIN0)
        _look_up(table, state, _TWIN1)
    if scaled is not None:
        _look_up(table, state, _TWIN2)
        _look_up(table, state, _TWIN3)


@scalar_function
def _cost(state: Any, own: Any, b: Any, t: int, place: Any, task: Any, last: Any) -> None:
    """Add the cost of step t, which sample b has just made, to the rows from `own` on; `last` is None before it."""
    cos_yaw, sin_yaw = state[_COS + b], state[_SIN + b]
    x, y, forward = place
    cost, memory = stage_cost(
        task, state[own + _MEMORY + b], t, state[own + _X + b], state[own + _Y + b], x, y, cos_yaw, sin_yaw, forward,
        _found(looks_up(task), state, own, b),
    )  # fmt: skip
    state[own + _TOTAL + b] += cost
    if looks_up(task) is None:
        state[own + _MEMORY + b] = memory
    if looks_up(task) is None or last is not None:
        state[own + _X + b] = x
        state[own + _Y + b] = y


@scalar_function
def _place(state: Any, b: Any, base: Any) -> Any:
    """Tracked point of sample b and forward speed over its last step, under the point `base`."""
    x, y = tracked_of(state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b], base)
    return x, y, state[_FORWARD + b]


@scalar_function
def _ahead_place(state: Any, b: Any, base: Any, twin: Any, start: Any) -> Any:
    """As `_place`, for a twin of the point `base` that differs in x_icr: it turns about the same axle."""
    x, y, forward = _place(state, b, base)
    farther = twin.x_icr_m - base.x_icr_m
    return x - farther * (state[_COS + b] - start[2]), y - farther * (state[_SIN + b] - start[3]), forward


@scalar_function
def _scaled_place(state: Any, b: Any, base: Any, twin: Any, start: Any) -> Any:
    """As `_place`, for a twin of the point `base` whose path is the same at another scale."""
    scale = twin.half_radius_m / base.half_radius_m
    ahead, stays = twin.x_icr_m - scale * base.x_icr_m, cast_like(1.0, scale) - scale
    axle_x = scale * state[_AXLE_X + b] + (stays * start[0] + ahead * start[2])
    axle_y = scale * state[_AXLE_Y + b] + (stays * start[1] + ahead * start[3])
    x, y = tracked_of(axle_x, axle_y, state[_COS + b], state[_SIN + b], twin)
    return x, y, scale * state[_FORWARD + b]


@scalar_function
def _follows(
    looks: Any, state: Any, b: Any, base: Any, skip_mean: Any, ahead: Any, scaled: Any, start: Any, task: Any
) -> None:
    """Move the memories of a point and its twins on; nothing without a table."""
    if looks is None:
        return
    if skip_mean is None:
        _follow(looks, state, _OWN, b, _place(state, b, base), task)
    if ahead is not None:
        _follow(looks, state, _TWIN0, b, _ahead_place(state, b, base, ahead[0], start), task)
        _follow(looks, state, _TWIN1, b, _ahead_place(state, b, base, ahead[1], start), task)
    if scaled is not None:
        _follow(looks, state, _TWIN2, b, _scaled_place(state, b, base, scaled[0], start), task)
        _follow(looks, state, _TWIN3, b, _scaled_place(state, b, base, scaled[1], start), task)


@scalar_function
def _costs(
    state: Any,
    b: Any,
    t: int,
    base: Any,
    skip_mean: Any,
    ahead: Any,
    scaled: Any,
    start: Any,
    task: Any,
    last: Any,
) -> None:
    """Costs of step t under a point and its twins, pairs or None."""
    if skip_mean is None:
        _cost(state, _OWN, b, t, _place(state, b, base), task, last)
    if ahead is not None:
        _cost(state, _TWIN0, b, t, _ahead_place(state, b, base, ahead[0], start), task, last)
        _cost(state, _TWIN1, b, t, _ahead_place(state, b, base, ahead[1], start), task, last)
    if scaled is not None:
        _cost(state, _TWIN2, b, t, _scaled_place(state, b, base, scaled[0], start), task, last)
        _cost(state, _TWIN3, b, t, _scaled_place(state, b, base, scaled[1], start), task, last)


@block_function
def _end(costs: Any, at: Any, state: Any, own: Any, task: Any) -> None:
    """Write the costs of the rows from `own` on to `costs[at:at + BLOCK]`."""
    tune_loops()
    for b in range(BLOCK):
        costs[at + b] = state[own + _TOTAL + b] + terminal_cost(
            task, state[own + _MEMORY + b], state[own + _X + b], state[own + _Y + b], state[_COS + b], state[_SIN + b],
            _found(looks_up(task), state, own, b),
        )  # fmt: skip


@block_function
def _roll(
    costs: Any, at: Any, ahead_at: Any, scaled_at: Any, horizon: int, commands: Any, late: int, wheels: Any,
    state: Any, start: Any, base: Any, skip_mean: Any, ahead: Any, scaled: Any, effects: Any, integration: Any,
    task: Any,
) -> None:  # fmt: skip
    """Roll the block out from `start` with its wheels turning as in `wheels`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples. Twins, the
    pairs `ahead` and `scaled` or None, are costed along with it, at `ahead_at` and `scaled_at`; they alone, where
    `skip_mean` is not None. A step is costed together with the next one's motion: neither waits for the other, which
    saves a sixth of the time.
    """
    tune_loops()
    x, y, cos_yaw, sin_yaw = start[0], start[1], start[2], start[3]
    for b in range(BLOCK):
        state[_AXLE_X + b], state[_AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, lane_base(base, at + b))
        state[_COS + b] = cos_yaw
        state[_SIN + b] = sin_yaw
        if skip_mean is None:
            _begin(state, _OWN, b, start, task)
        _begin(state, _TWIN0, b, start, task)
        _begin(state, _TWIN1, b, start, task)
        _begin(state, _TWIN2, b, start, task)
        _begin(state, _TWIN3, b, start, task)
    _look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, x) * integration.step_s
        if t == 0:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _move(
                    state, b, _rolling(wheels, t, b, commands, late, horizon, acting), time_s, here, acting, integration
                )  # fmt: skip
                _follows(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task)
        else:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _costs(state, b, t - 1, here, skip_mean, ahead, scaled, start, task, None)
                _move(
                    state, b, _rolling(wheels, t, b, commands, late, horizon, acting), time_s, here, acting, integration
                )  # fmt: skip
                _follows(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task)
        _look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
    for b in range(BLOCK):
        _costs(state, b, horizon - 1, lane_base(base, at + b), skip_mean, ahead, scaled, start, task, True)
    # One after the other: a loop that wrote to all at once would not be vectorised.
    if skip_mean is None:
        _end(costs, at, state, _OWN, task)
    if ahead is not None:
        _end(costs, ahead_at[0], state, _TWIN0, task)
        _end(costs, ahead_at[1], state, _TWIN1, task)
    if scaled is not None:
        _end(costs, scaled_at[0], state, _TWIN2, task)
        _end(costs, scaled_at[1], state, _TWIN3, task)


@scalar_function
def _bases(base: Any, pair: Any) -> Any:
    """Base coefficients of a pair of points."""
    return base_point(base, pair[0]), base_point(base, pair[1])


@scalar_function
def _places(pair: Any, padded: int, lane: Any) -> Any:
    """Where the costs of a pair of points begin."""
    return U(pair[0] * padded) + lane, U(pair[1] * padded) + lane


@block_function
def _roll_points(
    each: Any, skip_mean: Any, ahead: Any, scaled: Any, system: Any, costs: Any, points: int, padded: int, block: int,
    horizon: int, commands: Any, state: Any,
) -> None:  # fmt: skip
    integration = integration_from(system.series, system.wide)
    start, wheels, task = system.start, system.wheels, system.task
    lane = U(block) * BLOCK
    for i in range(points):
        at = U(i * padded) + lane
        here, acting = base_point(system.base, i), effect_point(system.effects, i)
        late = system.history - delay_steps(acting)
        if each is not None:
            if needs_change(acting) or not wheels_follow(acting):
                _turn_wheels(wheels, at, horizon, commands, state, start, system.effects, late, integration.step_s)
            _roll(
                costs, at, None, None, horizon, commands, late, wheels, state, start, system.base, None, None, None,
                system.effects, integration, task,
            )  # fmt: skip
        else:
            if (i == 0 or system.wheels_differ) and (needs_change(acting) or not wheels_follow(acting)):
                _turn_wheels(wheels, at, horizon, commands, state, start, acting, late, integration.step_s)
            alone = i > 0 or skip_mean is None
            if ahead is not None:
                # Whatever leads twins beside the first point is costed in a rollout of its own.
                alone = alone and (ahead[i, 0] == -1 or (skip_mean is not None and ahead[i, 0] >= 0))
                if ahead[i, 0] >= 0:
                    if scaled is None:
                        _roll(
                            costs, at, _places(ahead[i], padded, lane), None, horizon, commands, late, wheels, state,
                            start, here, skip_mean, _bases(system.base, ahead[i]), None, acting, integration, task,
                        )  # fmt: skip
                    else:
                        _roll(
                            costs, at, _places(ahead[i], padded, lane), _places(scaled[i], padded, lane), horizon,
                            commands, late, wheels, state, start, here, skip_mean, _bases(system.base, ahead[i]),
                            _bases(system.base, scaled[i]), acting, integration, task,
                        )  # fmt: skip
            if alone:
                _roll(
                    costs, at, None, None, horizon, commands, late, wheels, state, start, here, None, None, None,
                    acting, integration, task,
                )  # fmt: skip


@specialise(roll_block)
def _roll_block(
    system: Any, costs: Any, points: Any, padded: Any, block: Any, horizon: Any, commands: Any, state: Any
) -> Callable[..., Any] | None:
    if getattr(system, "instance_class", None) is not SkidSteer:
        return None

    def roll_skid_steer(
        system: Any, costs: Any, points: Any, padded: Any, block: Any, horizon: Any, commands: Any, state: Any
    ) -> None:
        _roll_points(
            system.each, system.skip_mean, system.ahead, system.scaled, system, costs, points, padded, block, horizon,
            commands, state,
        )  # fmt: skip

    return roll_skid_steer
