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
from disco_hw.model.jit import block_function, cast_like, prefer_wide_vectors, specialise
from disco_hw.model.step import axle_of, follows_wheels, step, tracked_of
from disco_hw.model.tables import base_point, effect_point, lane_base, lane_effects

# Rows of a block's state; one flat buffer at fixed offsets spares the compiler all checks for overlap.
_AXLE_X, _AXLE_Y, _X, _Y, _COS, _SIN, _LEFT, _RIGHT, _MEMORY, _TOTAL = (U(row) * BLOCK for row in range(10))
_CHANNELS = 2


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (8,): x, y relative to the task's origin (m), cos and sin of yaw, left and right wheel speed (rad/s), time
    (s), the task's memory. `base`, `effects`: coefficient tables of L points; `each` is None, or anything else if the
    tables hold points for every sample, (L, K'). `history`: rows of commands from before the plan.
    """

    start: Any
    base: Any
    effects: Any
    each: Any
    integration: Any
    task: Any
    history: Any


@block_function
def _roll(
    costs: Any, at: Any, horizon: int, commands: Any, state: Any, history: int, start: Any, base: Any, effects: Any,
    late: int, integration: Any, task: Any,
) -> None:  # fmt: skip
    """Roll the block's commands out from `start`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples.
    """
    prefer_wide_vectors()
    x, y, cos_yaw, sin_yaw = start[0], start[1], start[2], start[3]
    for b in range(BLOCK):
        here = lane_base(base, at + b)
        state[_AXLE_X + b], state[_AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, here)
        state[_X + b] = x
        state[_Y + b] = y
        state[_COS + b] = cos_yaw
        state[_SIN + b] = sin_yaw
        state[_LEFT + b] = start[4]
        state[_RIGHT + b] = start[5]
        state[_MEMORY + b] = start[7]
        state[_TOTAL + b] = cast_like(0.0, x)
    for t in range(horizon):
        time_s = start[6] + cast_like(t, x) * integration.step_s
        recent = U((t + late) * _CHANNELS) * BLOCK
        older = U(max(t + late - 1, 0) * _CHANNELS) * BLOCK
        for b in range(BLOCK):
            here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
            left = command_delay.blend(commands[recent + b], commands[older + b], acting.command_delay)
            right = command_delay.blend(commands[recent + BLOCK + b], commands[older + BLOCK + b], acting.command_delay)
            axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, forward, _ = step(
                state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b],
                state[_LEFT + b], state[_RIGHT + b], left, right, time_s, here, acting, integration,
            )  # fmt: skip
            x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, here)
            cost, memory = stage_cost(
                task, state[_MEMORY + b], t, state[_X + b], state[_Y + b], x, y, cos_yaw, sin_yaw, forward
            )
            state[_AXLE_X + b] = axle_x
            state[_AXLE_Y + b] = axle_y
            state[_X + b] = x
            state[_Y + b] = y
            state[_COS + b] = cos_yaw
            state[_SIN + b] = sin_yaw
            state[_TOTAL + b] += cost
            if follows_wheels(acting):
                state[_LEFT + b] = wheel_left
                state[_RIGHT + b] = wheel_right
            if has_memory(task):
                state[_MEMORY + b] = memory
    for b in range(BLOCK):
        costs[at + b] = state[_TOTAL + b] + terminal_cost(
            task, state[_MEMORY + b], state[_X + b], state[_Y + b], state[_COS + b], state[_SIN + b]
        )


@block_function
def _roll_points(
    each: Any, system: Any, costs: Any, points: int, padded: int, block: int, horizon: int, commands: Any, state: Any
) -> None:
    history = system.history
    for i in range(points):
        at = U(i * padded) + U(block) * BLOCK
        shared = effect_point(system.effects, i)
        late = history - command_delay.whole_steps(shared.command_delay)
        if each is None:
            _roll(
                costs, at, horizon, commands, state, history, system.start, base_point(system.base, i), shared, late,
                system.integration, system.task,
            )  # fmt: skip
        else:
            _roll(
                costs, at, horizon, commands, state, history, system.start, system.base, system.effects, late,
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
