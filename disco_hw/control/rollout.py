"""The fused rollout: bounds, motion and cost of all samples and parameter points, block by block.

One thread, no allocation. Samples are the innermost dimension everywhere, in blocks of fixed size, so that every loop
over them vectorises without a remainder and a block's commands and states stay in the first-level cache.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from disco_hw.control.blocks import BLOCK, PAIR, U
from disco_hw.control.tasks.terms import has_memory, stage_cost, terminal_cost
from disco_hw.model.effects import command_delay
from disco_hw.model.jit import block_function, cast_like, prefer_wide_vectors, scalar_function
from disco_hw.model.step import body_velocity, follows_wheels, move, wheel_step
from disco_hw.model.tables import base_point, effect_point

_AXLE_X, _AXLE_Y, _X, _Y, _COS, _SIN, _LEFT, _RIGHT, _MEMORY, _TOTAL = (U(row) * BLOCK for row in range(10))
STATE_SIZE = 10 * int(BLOCK)


class Start(NamedTuple):
    """State that all rollouts start from, relative to the task's origin: m, m, 1, 1, rad/s, rad/s, s."""

    x_m: Any
    y_m: Any
    cos_yaw: Any
    sin_yaw: Any
    wheel_left: Any
    wheel_right: Any
    time_s: Any


class Basis(NamedTuple):
    """How noise at knots becomes noise over time: `first` (T,) int, `weights` (T, 4) or None for one knot a step."""

    first: Any
    weights: Any


class Limits(NamedTuple):
    """Bounds of a command (rad/s), its largest change in a step (rad/s) and the command before the plan (rad/s)."""

    speed: Any
    change: Any
    before_left: Any
    before_right: Any


@scalar_function
def clip(value: Any, low: Any, high: Any) -> Any:
    """Value within [low, high]; NaN stays NaN."""
    value = low if value < low else value
    return high if value > high else value


@scalar_function
def noise(knots: Any, at: Any, weights: Any) -> Any:
    """Noise of the sample at index `at`: weighted sum over four knots from there on, or that knot alone for None."""
    if weights is None:
        return knots[at]
    w0, w1, w2, w3 = weights
    return (w0 * knots[at] + w1 * knots[at + PAIR]) + (w2 * knots[at + U(2) * PAIR] + w3 * knots[at + U(3) * PAIR])


@scalar_function
def basis_weights(weights: Any, t: int) -> Any:
    """Weights of the four knots that act at step t, or None."""
    if weights is None:
        return None
    return weights[t, 0], weights[t, 1], weights[t, 2], weights[t, 3]


@block_function
def expand(
    commands: Any, state: Any, history: int, nominal: Any, knots: Any, first: Any, basis: Any, limits: Any
) -> None:
    """Commands of one block of samples: nominal plus noise, within the limits of speed and acceleration.

    Writes `commands` (history + T, 2, BLOCK) from row `history` on; `nominal` (T, 2), `knots` (blocks, R, 2, BLOCK).
    """
    prefer_wide_vectors()
    change, top = limits.change, limits.speed
    for b in range(BLOCK):
        state[_LEFT + b] = limits.before_left
        state[_RIGHT + b] = limits.before_right
    for t in range(nominal.shape[0]):
        middle_left, middle_right = nominal[t, 0], nominal[t, 1]
        weights = basis_weights(basis.weights, t)
        knot = first + U(basis.first[t]) * PAIR
        row = U(history + t) * PAIR
        for b in range(BLOCK):
            left = middle_left + noise(knots, knot + b, weights)
            right = middle_right + noise(knots, knot + BLOCK + b, weights)
            left = clip(clip(left, state[_LEFT + b] - change, state[_LEFT + b] + change), -top, top)
            right = clip(clip(right, state[_RIGHT + b] - change, state[_RIGHT + b] + change), -top, top)
            commands[row + b] = left
            commands[row + BLOCK + b] = right
            state[_LEFT + b] = left
            state[_RIGHT + b] = right


@block_function
def roll(
    costs: Any,
    at: Any,
    horizon: int,
    commands: Any,
    state: Any,
    history: int,
    start: Any,
    base: Any,
    effects: Any,
    integration: Any,
    task: Any,
    memory: float,
) -> None:
    """Roll the block's commands out from `start` with one parameter point; writes `costs[point, block]` (BLOCK,)."""
    prefer_wide_vectors()
    axle_x = start.x_m + base.x_icr_m * start.cos_yaw
    axle_y = start.y_m + base.x_icr_m * start.sin_yaw
    for b in range(BLOCK):
        state[_AXLE_X + b] = axle_x
        state[_AXLE_Y + b] = axle_y
        state[_X + b] = start.x_m
        state[_Y + b] = start.y_m
        state[_COS + b] = start.cos_yaw
        state[_SIN + b] = start.sin_yaw
        state[_LEFT + b] = start.wheel_left
        state[_RIGHT + b] = start.wheel_right
        state[_MEMORY + b] = memory
        state[_TOTAL + b] = cast_like(0.0, memory)
    late = history - command_delay.whole_steps(effects.command_delay)
    for t in range(horizon):
        recent = U(t + late) * PAIR
        older = U(max(t + late - 1, 0)) * PAIR
        for b in range(BLOCK):
            left = command_delay.blend(commands[recent + b], commands[older + b], effects.command_delay)
            right = command_delay.blend(
                commands[recent + BLOCK + b], commands[older + BLOCK + b], effects.command_delay
            )
            end_left, end_right, mean_left, mean_right = wheel_step(
                left, right, state[_LEFT + b], state[_RIGHT + b], effects
            )
            forward, lateral, turn = body_velocity(mean_left, mean_right, base, effects)
            axle_x, axle_y, cos_yaw, sin_yaw = move(
                state[_AXLE_X + b], state[_AXLE_Y + b], state[_COS + b], state[_SIN + b],
                forward, lateral, turn, integration,
            )  # fmt: skip
            x = axle_x - base.x_icr_m * cos_yaw
            y = axle_y - base.x_icr_m * sin_yaw
            cost, memory_now = stage_cost(
                task, state[_MEMORY + b], t, state[_X + b], state[_Y + b], x, y, cos_yaw, sin_yaw, forward
            )
            state[_AXLE_X + b] = axle_x
            state[_AXLE_Y + b] = axle_y
            state[_X + b] = x
            state[_Y + b] = y
            state[_COS + b] = cos_yaw
            state[_SIN + b] = sin_yaw
            state[_TOTAL + b] += cost
            if follows_wheels(effects):
                state[_LEFT + b] = end_left
                state[_RIGHT + b] = end_right
            if has_memory(task):
                state[_MEMORY + b] = memory_now
    for b in range(BLOCK):
        costs[at + b] = state[_TOTAL + b] + terminal_cost(
            task, state[_MEMORY + b], state[_X + b], state[_Y + b], state[_COS + b], state[_SIN + b]
        )


@block_function
def roll_block(
    costs: Any,
    points: int,
    samples: int,
    block: int,
    horizon: int,
    commands: Any,
    state: Any,
    history: int,
    start: Any,
    base: Any,
    effects: Any,
    integration: Any,
    task: Any,
    memory: float,
) -> None:
    """Costs of one block of samples under all parameter points."""
    for i in range(points):
        here, effects_here = base_point(base, i), effect_point(effects, i)
        at = U(i * samples) + U(block) * BLOCK
        roll(costs, at, horizon, commands, state, history, start, here, effects_here, integration, task, memory)
