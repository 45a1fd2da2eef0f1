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
from disco_hw.model.effects import command_delay
from disco_hw.model.jit import block_function, cast_like, scalar_function, specialise, tune_loops
from disco_hw.model.step import axle_of, body_step, needs_change, tracked_of, wheel_step
from disco_hw.model.tables import base_point, effect_point, lane_base, lane_effects

# Rows of a block's state; one flat buffer at fixed offsets spares the compiler all checks for overlap.
_AXLE_X, _AXLE_Y, _COS, _SIN, _FORWARD, _X, _Y, _MEMORY, _TOTAL = (U(row) * BLOCK for row in range(9))
_LEFT, _RIGHT = U(0) * BLOCK, BLOCK
_CHANNELS = 2
# Rows of the wheels' motion for every step: sum, right minus left, change of the sum.
_SUM, _DIFFERENCE, _CHANGE = (U(row) * BLOCK for row in range(3))
WHEEL_ROWS = 3
_WHEEL_STRIDE = U(WHEEL_ROWS) * BLOCK


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (8,): x, y relative to the task's origin (m), cos and sin of yaw, left and right wheel speed (rad/s), time
    (s), the task's memory. `base`, `effects`: coefficient tables of L points; `each` is None, or anything else if the
    tables hold points for every sample, (L, K'). `history`: rows of commands from before the plan. `wheels`: buffer of
    the wheels' motion, (T, WHEEL_ROWS, BLOCK); `wheels_differ`: whether the points differ in how the wheels turn.
    """

    start: Any
    base: Any
    effects: Any
    each: Any
    integration: Any
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
        row = U(t) * _WHEEL_STRIDE
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
                wheels[row + _CHANGE + b] = (end_left + end_right) - (was_left + was_right)


@scalar_function
def _move(state: Any, b: Any, wheels: Any, row: Any, time_s: Any, base: Any, effects: Any, integration: Any) -> None:
    """Move sample b on by one step."""
    axle_x, axle_y, cos_yaw, sin_yaw, forward, _ = body_step(
        state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b],
        wheels[row + _SUM + b], wheels[row + _DIFFERENCE + b], wheels[row + _CHANGE + b], time_s,
        base, effects, integration,
    )  # fmt: skip
    state[_AXLE_X + b] = axle_x
    state[_AXLE_Y + b] = axle_y
    state[_COS + b] = cos_yaw
    state[_SIN + b] = sin_yaw
    state[_FORWARD + b] = forward


@scalar_function
def _cost(state: Any, b: Any, t: int, base: Any, task: Any) -> None:
    """Add the cost of step t, which sample b has just made."""
    cos_yaw, sin_yaw = state[_COS + b], state[_SIN + b]
    x, y = tracked_of(state[_AXLE_X + b], state[_AXLE_Y + b], cos_yaw, sin_yaw, base)
    cost, memory = stage_cost(
        task, state[_MEMORY + b], t, state[_X + b], state[_Y + b], x, y, cos_yaw, sin_yaw, state[_FORWARD + b]
    )
    state[_X + b] = x
    state[_Y + b] = y
    state[_TOTAL + b] += cost
    if has_memory(task):
        state[_MEMORY + b] = memory


@block_function
def _roll(
    costs: Any, at: Any, horizon: int, wheels: Any, state: Any, start: Any, base: Any, effects: Any, integration: Any,
    task: Any,
) -> None:  # fmt: skip
    """Roll the block out from `start` with its wheels turning as in `wheels`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples. A step is
    costed together with the next one's motion: neither waits for the other, which saves a sixth of the time.
    """
    tune_loops()
    x, y, cos_yaw, sin_yaw = start[0], start[1], start[2], start[3]
    for b in range(BLOCK):
        state[_AXLE_X + b], state[_AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, lane_base(base, at + b))
        state[_X + b] = x
        state[_Y + b] = y
        state[_COS + b] = cos_yaw
        state[_SIN + b] = sin_yaw
        state[_MEMORY + b] = start[7]
        state[_TOTAL + b] = cast_like(0.0, x)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, x) * integration.step_s
        row = U(t) * _WHEEL_STRIDE
        if t == 0:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _move(state, b, wheels, row, time_s, here, acting, integration)
        else:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _cost(state, b, t - 1, here, task)
                _move(state, b, wheels, row, time_s, here, acting, integration)
    for b in range(BLOCK):
        _cost(state, b, horizon - 1, lane_base(base, at + b), task)
        costs[at + b] = state[_TOTAL + b] + terminal_cost(
            task, state[_MEMORY + b], state[_X + b], state[_Y + b], state[_COS + b], state[_SIN + b]
        )


@block_function
def _roll_points(
    each: Any, system: Any, costs: Any, points: int, padded: int, block: int, horizon: int, commands: Any, state: Any
) -> None:
    step_s = system.integration.step_s
    for i in range(points):
        at = U(i * padded) + U(block) * BLOCK
        here, acting = base_point(system.base, i), effect_point(system.effects, i)
        late = system.history - command_delay.whole_steps(acting.command_delay)
        if each is None:
            if i == 0 or system.wheels_differ:
                _turn_wheels(system.wheels, at, horizon, commands, state, system.start, acting, late, step_s)
            _roll(costs, at, horizon, system.wheels, state, system.start, here, acting, system.integration, system.task)
        else:
            _turn_wheels(system.wheels, at, horizon, commands, state, system.start, system.effects, late, step_s)
            _roll(
                costs, at, horizon, system.wheels, state, system.start, system.base, system.effects,
                system.integration, system.task,
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
