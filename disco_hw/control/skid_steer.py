"""The skid-steer robot as a system that DISCO rolls out: motion by the model's step, cost by the task.

One thread, no allocation. Samples are the innermost dimension everywhere, in blocks of fixed size, so that every loop
over them vectorises without a remainder and a block's commands and states stay in the first-level cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from disco_hw.control.blocks import BLOCK, U
from disco_hw.control.rollout import roll_block
from disco_hw.control.tasks.terms import has_memory, stage_cost, terminal_cost
from disco_hw.model.compose import needs_change
from disco_hw.model.effects import command_delay
from disco_hw.model.jit import block_function, cast_like, scalar_function, specialise, tune_loops
from disco_hw.model.step import axle_of, body_step, integration_from, tracked_of, wheel_step
from disco_hw.model.tables import base_point, effect_point, lane_base, lane_effects

# Rows of a block's state; one flat buffer at fixed offsets spares the compiler all checks for overlap. Three sets of
# rows for what differs between points that share the axle's motion.
_AXLE_X, _AXLE_Y, _COS, _SIN, _FORWARD = (U(row) * BLOCK for row in range(5))
_LEFT, _RIGHT = U(0) * BLOCK, BLOCK
_OWN, _FIRST_TWIN, _SECOND_TWIN = U(5) * BLOCK, U(9) * BLOCK, U(13) * BLOCK
_X, _Y, _MEMORY, _TOTAL = (U(row) * BLOCK for row in range(4))
_CHANNELS = 2
# The wheels' motion: for every step a row of their sum and one of right minus left; then a row of the sum's change.
_SUM, _DIFFERENCE = U(0) * BLOCK, BLOCK
_WHEEL_STRIDE = U(2) * BLOCK
WHEEL_ROWS = 3


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (8,): x, y relative to the task's origin (m), cos and sin of yaw, left and right wheel speed (rad/s), time
    (s), the task's memory. `base`, `effects`: coefficient tables of L points; `each` is None, or anything else if the
    tables hold points for every sample, (L, K'). `twins` (L, 2) int: points that differ from a point in x_icr alone,
    -1 for none, -2 for a point that is itself a twin. `series` (8,), `wide`: how a step is integrated. `history`: rows
    of commands from before the plan. `wheels`: buffer of the wheels' motion, T * WHEEL_ROWS * BLOCK; `wheels_differ`:
    whether the points differ in how the wheels turn.
    """

    start: Any
    base: Any
    effects: Any
    each: Any
    twins: Any
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
            left = command_delay.blend(commands[recent + b], commands[older + b], acting.command_delay)
            right = command_delay.blend(commands[recent + BLOCK + b], commands[older + BLOCK + b], acting.command_delay)
            was_left, was_right = state[_LEFT + b], state[_RIGHT + b]
            end_left, end_right, mean_left, mean_right = wheel_step(left, right, was_left, was_right, time_s, acting)
            state[_LEFT + b] = end_left
            state[_RIGHT + b] = end_right
            wheels[row + _SUM + b] = mean_left + mean_right
            wheels[row + _DIFFERENCE + b] = mean_right - mean_left
            if needs_change(acting):
                wheels[change_row + b] = (end_left + end_right) - (was_left + was_right)


@scalar_function
def _move(
    state: Any, b: Any, wheels: Any, row: Any, change_row: Any, time_s: Any, base: Any, effects: Any, integration: Any
) -> None:
    """Move sample b on by one step."""
    axle_x, axle_y, cos_yaw, sin_yaw, forward, _ = body_step(
        state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b],
        wheels[row + _SUM + b], wheels[row + _DIFFERENCE + b], wheels[change_row + b], time_s,
        base, effects, integration,
    )  # fmt: skip
    state[_AXLE_X + b] = axle_x
    state[_AXLE_Y + b] = axle_y
    state[_COS + b] = cos_yaw
    state[_SIN + b] = sin_yaw
    state[_FORWARD + b] = forward


@scalar_function
def _begin(state: Any, own: Any, b: Any, start: Any) -> None:
    """Set the rows from `own` on to the start."""
    state[own + _X + b] = start[0]
    state[own + _Y + b] = start[1]
    state[own + _MEMORY + b] = start[7]
    state[own + _TOTAL + b] = cast_like(0.0, start[0])


@scalar_function
def _cost(state: Any, own: Any, b: Any, t: int, axle_x: Any, axle_y: Any, base: Any, task: Any) -> None:
    """Add the cost of step t, which sample b has just made, to the rows from `own` on."""
    cos_yaw, sin_yaw = state[_COS + b], state[_SIN + b]
    x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, base)
    cost, memory = stage_cost(
        task, state[own + _MEMORY + b], t, state[own + _X + b], state[own + _Y + b], x, y, cos_yaw, sin_yaw,
        state[_FORWARD + b],
    )  # fmt: skip
    state[own + _X + b] = x
    state[own + _Y + b] = y
    state[own + _TOTAL + b] += cost
    if has_memory(task):
        state[own + _MEMORY + b] = memory


@scalar_function
def _cost_twin(state: Any, own: Any, b: Any, t: int, base: Any, twin: Any, start: Any, task: Any) -> None:
    """As `_cost`, for a twin of the point `base`: its axle moves alike from another place. None has no cost."""
    if twin is None:
        return
    ahead = twin.x_icr_m - base.x_icr_m
    _cost(state, own, b, t, state[_AXLE_X + b] + ahead * start[2], state[_AXLE_Y + b] + ahead * start[3], twin, task)


@scalar_function
def _end(costs: Any, at: Any, state: Any, own: Any, b: Any, task: Any) -> None:
    """Write the cost of the rows from `own` on."""
    costs[at + b] = state[own + _TOTAL + b] + terminal_cost(
        task, state[own + _MEMORY + b], state[own + _X + b], state[own + _Y + b], state[_COS + b], state[_SIN + b]
    )


@scalar_function
def _end_twin(costs: Any, at: Any, state: Any, own: Any, b: Any, twin: Any, task: Any) -> None:
    """As `_end`, for a twin; nothing for None."""
    if twin is not None:
        _end(costs, at, state, own, b, task)


@block_function
def _roll(
    costs: Any, at: Any, first_at: Any, second_at: Any, horizon: int, wheels: Any, state: Any, start: Any, base: Any,
    first_twin: Any, second_twin: Any, effects: Any, integration: Any, task: Any,
) -> None:  # fmt: skip
    """Roll the block out from `start` with its wheels turning as in `wheels`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples. Twins differ
    from `base` in x_icr alone and are costed along with it, at `first_at` and `second_at`; or None. A step is costed
    together with the next one's motion: neither waits for the other, which saves a sixth of the time.
    """
    tune_loops()
    x, y, cos_yaw, sin_yaw = start[0], start[1], start[2], start[3]
    for b in range(BLOCK):
        state[_AXLE_X + b], state[_AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, lane_base(base, at + b))
        state[_COS + b] = cos_yaw
        state[_SIN + b] = sin_yaw
        _begin(state, _OWN, b, start)
        _begin(state, _FIRST_TWIN, b, start)
        _begin(state, _SECOND_TWIN, b, start)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, x) * integration.step_s
        row, change_row = U(t) * _WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
        if t == 0:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _move(state, b, wheels, row, change_row, time_s, here, acting, integration)
        else:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _cost(state, _OWN, b, t - 1, state[_AXLE_X + b], state[_AXLE_Y + b], here, task)
                _cost_twin(state, _FIRST_TWIN, b, t - 1, here, first_twin, start, task)
                _cost_twin(state, _SECOND_TWIN, b, t - 1, here, second_twin, start, task)
                _move(state, b, wheels, row, change_row, time_s, here, acting, integration)
    for b in range(BLOCK):
        here = lane_base(base, at + b)
        _cost(state, _OWN, b, horizon - 1, state[_AXLE_X + b], state[_AXLE_Y + b], here, task)
        _cost_twin(state, _FIRST_TWIN, b, horizon - 1, here, first_twin, start, task)
        _cost_twin(state, _SECOND_TWIN, b, horizon - 1, here, second_twin, start, task)
        _end(costs, at, state, _OWN, b, task)
        _end_twin(costs, first_at, state, _FIRST_TWIN, b, first_twin, task)
        _end_twin(costs, second_at, state, _SECOND_TWIN, b, second_twin, task)


@block_function
def _roll_points(
    each: Any, system: Any, costs: Any, points: int, padded: int, block: int, horizon: int, commands: Any, state: Any
) -> None:
    integration = integration_from(system.series, system.wide)
    start, wheels, task = system.start, system.wheels, system.task
    for i in range(points):
        at = U(i * padded) + U(block) * BLOCK
        here, acting = base_point(system.base, i), effect_point(system.effects, i)
        late = system.history - command_delay.whole_steps(acting.command_delay)
        if each is None:
            first, second = system.twins[i, 0], system.twins[i, 1]
            if i == 0 or system.wheels_differ:
                _turn_wheels(wheels, at, horizon, commands, state, start, acting, late, integration.step_s)
            if first >= 0:
                first_at = U(first * padded) + U(block) * BLOCK
                second_at = U(second * padded) + U(block) * BLOCK
                _roll(
                    costs, at, first_at, second_at, horizon, wheels, state, start, here,
                    base_point(system.base, first), base_point(system.base, second), acting, integration, task,
                )  # fmt: skip
            elif first == -1:
                _roll(costs, at, at, at, horizon, wheels, state, start, here, None, None, acting, integration, task)
        else:
            _turn_wheels(wheels, at, horizon, commands, state, start, system.effects, late, integration.step_s)
            _roll(
                costs, at, at, at, horizon, wheels, state, start, system.base, None, None, system.effects, integration,
                task,
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
        _roll_points(system.each, system, costs, points, padded, block, horizon, commands, state)

    return roll_skid_steer
