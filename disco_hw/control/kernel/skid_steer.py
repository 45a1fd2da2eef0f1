"""The skid-steer robot as a system that DISCO rolls out: motion by the model's step, cost by the task.

One thread, no allocation; docs/kernel.md draws the rows of a block's state. Points that differ only in ways that leave
the axle's path alike are equivalent (`parameter_points.equivalent_points`): one rollout serves them all, and each of
them is costed. What is absent is None, in arguments of their own, as the compiler drops a branch only for those.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba import types
from numpy.typing import NDArray

from disco_hw.control.kernel import (
    AHEAD0,
    AHEAD1,
    AXLE_X,
    AXLE_Y,
    BLOCK,
    BODY_REMEMBERED,
    CHANNELS,
    COS,
    DIFFERENCE,
    FORWARD,
    LEFT,
    POINT,
    REMEMBERED,
    RIGHT,
    SCALED0,
    SCALED1,
    SIN,
    START_COS,
    START_LEFT,
    START_RIGHT,
    START_SIN,
    START_TIME,
    START_X,
    START_Y,
    SUM,
    WHEEL_STRIDE,
    Floats,
    Terms,
    U,
    looks_up,
    rolls_out,
)
from disco_hw.control.kernel.avoid import LOOK_EVERY, Area, bends_of, has_detours
from disco_hw.control.kernel.rollout_costs import (
    Absent,
    BasePair,
    Place,
    add_costs,
    avoid_shapes,
    begin_costs,
    end_costs,
    follow_points,
    look_ups,
)
from disco_hw.jit import block_function, cast_like, compiled_only, scalar_function, specialise, tune_loops
from disco_hw.model.added_terms import count_means
from disco_hw.model.coefficients import (
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
    wheel_step,
    wheels_follow,
)

Pairs: TypeAlias = NDArray[np.int64] | None
"""For each of L points the two that are equivalent to it in one way, (L, 2), or None."""
CostPlaces: TypeAlias = tuple[np.uintp, np.uintp] | None
"""Return the indices at which the costs of a pair of points begin."""


class SkidSteer(NamedTuple):
    """A skid-steer robot before its task.

    `start` (10,): at the package's places START_X to CARRIED_Y.
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
    first_input: int,
    step_s: float,
) -> None:
    """Mean wheel speeds of the block's samples over every step, as rows of `wheels`."""
    tune_loops()
    for b in range(BLOCK):
        state[LEFT + b] = start[START_LEFT]
        state[RIGHT + b] = start[START_RIGHT]
    _begin_means(means, state, REMEMBERED, point, U(0), effects.command_terms)
    for t in range(horizon):
        time_s = start[START_TIME] + cast_like(t, step_s) * step_s
        recent = U((t + first_input) * CHANNELS) * BLOCK
        older = U(max(t + first_input - 1, 0) * CHANNELS) * BLOCK
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
def _rolling(
    wheels: Floats, t: int, b: int, commands: Floats, first_input: int, horizon: int, effects: Coefficients
) -> Place:
    """Sum of the mean wheel speeds of sample b over step t, right minus left, and the sum's change (rad/s)."""
    if wheels_follow(effects) and not needs_change(effects):
        row = U(t + first_input) * WHEEL_STRIDE
        left, right = commands[row + LEFT + b], commands[row + RIGHT + b]
        return left + right, right - left, cast_like(0.0, left)
    row, change_row = U(t) * WHEEL_STRIDE, U(2 * horizon + t) * BLOCK
    return wheels[row + SUM + b], wheels[row + DIFFERENCE + b], wheels[change_row + b]


@scalar_function
def _move(
    state: Floats, b: int, rolling: Place, time_s: float, base: Base, effects: Coefficients, integration: Integration,
) -> None:  # fmt: skip
    """Move sample b on by one step."""
    wheel_sum, difference, change = rolling
    axle_x, axle_y, cos_yaw, sin_yaw, forward, _ = body_step(
        state[AXLE_X + b], state[AXLE_Y + b], state[COS + b], state[SIN + b],
        wheel_sum, difference, change, time_s, base, effects, integration,
        state, BODY_REMEMBERED + b, BLOCK,
    )  # fmt: skip
    state[AXLE_X + b] = axle_x
    state[AXLE_Y + b] = axle_y
    state[COS + b] = cos_yaw
    state[SIN + b] = sin_yaw
    state[FORWARD + b] = forward


@block_function
def _roll(
    costs: Floats, at: int, ahead_at: CostPlaces, scaled_at: CostPlaces, horizon: int, commands: Floats,
    first_input: int, wheels: Floats, state: Floats, start: Floats, means: Floats | None, point: int,
    base: Base, skip_mean: Absent, ahead: BasePair, scaled: BasePair, effects: Coefficients, integration: Integration,
    task: Terms, area: Area | None, straight: Absent,
) -> None:  # fmt: skip
    """Roll the block out from `start` with its wheels turning as in `wheels`; writes `costs[at:at + BLOCK]`.

    `base` and `effects` hold numbers, or arrays whose entries from `at` on belong to the block's samples. Equivalent
    points, the pairs `ahead` and `scaled` or None, are costed along with it, at `ahead_at` and `scaled_at`; they alone,
    where `skip_mean` is not None. A step is costed together with the next one's motion: neither waits for the other,
    which saves a sixth of the time.
    """
    tune_loops()
    bends = bends_of(area, straight)
    x, y, cos_yaw, sin_yaw = start[START_X], start[START_Y], start[START_COS], start[START_SIN]
    for b in range(BLOCK):
        state[AXLE_X + b], state[AXLE_Y + b] = axle_of(x, y, cos_yaw, sin_yaw, lane_base(base, at + b))
        state[COS + b] = cos_yaw
        state[SIN + b] = sin_yaw
        if skip_mean is None:
            begin_costs(state, POINT, b, start, task, bends)
        begin_costs(state, AHEAD0, b, start, task, bends)
        begin_costs(state, AHEAD1, b, start, task, bends)
        begin_costs(state, SCALED0, b, start, task, bends)
        begin_costs(state, SCALED1, b, start, task, bends)
    _begin_means(means, state, BODY_REMEMBERED, point, U(count_means(effects.command_terms)), effects.body_terms)
    look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
    for t in range(horizon):
        time_s = start[START_TIME] + cast_like(t, x) * integration.step_s
        if t == 0:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                _move(
                    state, b, _rolling(wheels, t, b, commands, first_input, horizon, acting), time_s, here, acting,
                    integration,
                )  # fmt: skip
                follow_points(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task, bends)
        else:
            for b in range(BLOCK):
                here, acting = lane_base(base, at + b), lane_effects(effects, at + b)
                add_costs(state, b, t - 1, here, skip_mean, ahead, scaled, start, task, None, bends)
                _move(
                    state, b, _rolling(wheels, t, b, commands, first_input, horizon, acting), time_s, here, acting,
                    integration,
                )  # fmt: skip
                follow_points(looks_up(task), state, b, here, skip_mean, ahead, scaled, start, task, bends)
        look_ups(looks_up(task), state, skip_mean, ahead, scaled, task)
        if t % LOOK_EVERY == LOOK_EVERY - 1:
            avoid_shapes(area, state, at, t, base, skip_mean, ahead, scaled, start)
    for b in range(BLOCK):
        add_costs(state, b, horizon - 1, lane_base(base, at + b), skip_mean, ahead, scaled, start, task, True, bends)
    # One after the other: a loop that wrote to all at once would not be vectorised.
    if skip_mean is None:
        end_costs(costs, at, state, POINT, task)
    if ahead_at is not None:
        end_costs(costs, ahead_at[0], state, AHEAD0, task)
        end_costs(costs, ahead_at[1], state, AHEAD1, task)
    if scaled_at is not None:
        end_costs(costs, scaled_at[0], state, SCALED0, task)
        end_costs(costs, scaled_at[1], state, SCALED1, task)


def _bases(pairs: Pairs, i: int, base: Base) -> BasePair:
    """Return base coefficients of the pair of points of point i; None without pairs. Compiled code only."""
    raise compiled_only(pairs)


@specialise(_bases)
def _bases_of(pairs: types.Type, i: Any, base: Any) -> Callable[..., BasePair]:
    if isinstance(pairs, types.NoneType):
        return lambda pairs, i, base: None
    return lambda pairs, i, base: (base_point(base, pairs[i, 0]), base_point(base, pairs[i, 1]))


def _places(pairs: Pairs, i: int, padded: int, lane: np.uintp) -> CostPlaces:
    """Return the places at which the costs of the pair of point i begin; None without pairs. Compiled code only."""
    raise compiled_only(pairs)


@specialise(_places)
def _places_of(pairs: types.Type, i: Any, padded: Any, lane: Any) -> Callable[..., CostPlaces]:
    if isinstance(pairs, types.NoneType):
        return lambda pairs, i, padded, lane: None
    return lambda pairs, i, padded, lane: (U(pairs[i, 0] * padded) + lane, U(pairs[i, 1] * padded) + lane)


@block_function
def _roll_points(
    each: Absent, skip_mean: Absent, ahead: Pairs, scaled: Pairs, system: SkidSteer, costs: Floats, points: int,
    padded: int, block: int, horizon: int, commands: Floats, state: Floats, straight: Absent,
) -> None:  # fmt: skip
    integration = integration_from(system.series, system.wide, system.euler)
    start, means = system.start, system.means
    wheels, task = system.wheels, system.task
    lane = U(block) * BLOCK
    for i in range(points):
        at = U(i * padded) + lane
        here, acting = base_point(system.base, i), effect_point(system.effects, i)
        first_input = system.history - delay_steps(acting)
        if each is not None:
            if needs_change(acting) or not wheels_follow(acting):
                _turn_wheels(
                    wheels,
                    at,
                    horizon,
                    commands,
                    state,
                    start,
                    means,
                    i,
                    system.effects,
                    first_input,
                    integration.step_s,
                )
            _roll(
                costs, at, None, None, horizon, commands, first_input, wheels, state, start, means, i,
                system.base, None, None, None, system.effects, integration, task, system.area, straight,
            )  # fmt: skip
        else:
            if (i == 0 or system.wheels_differ) and (needs_change(acting) or not wheels_follow(acting)):
                _turn_wheels(
                    wheels, at, horizon, commands, state, start, means, i, acting, first_input, integration.step_s
                )
            alone = i > 0 or skip_mean is None
            if ahead is not None:
                # Whatever leads equivalent points beside the first point is costed in a rollout of its own.
                alone = alone and (ahead[i, 0] == -1 or (skip_mean is not None and ahead[i, 0] >= 0))
                if ahead[i, 0] >= 0:
                    # By the types of both, as a branch for `scaled` that is not None would be compiled in vain.
                    _roll(
                        costs, at, _places(ahead, i, padded, lane), _places(scaled, i, padded, lane), horizon, commands,
                        first_input, wheels, state, start, means, i, here, skip_mean, _bases(ahead, i, system.base),
                        _bases(scaled, i, system.base), acting, integration, task, system.area, straight,
                    )  # fmt: skip
            if alone:
                _roll(
                    costs, at, None, None, horizon, commands, first_input, wheels, state, start, means, i, here,
                    None, None, None, acting, integration, task, system.area, straight,
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
