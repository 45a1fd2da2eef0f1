"""Gauss-Newton refinement of a plan: the bottom of the valley that sampling has found.

Minimises the squared distances to a timed reference, the squared error of the last heading and the squared changes of
the commands, in the mean of the belief. Derivatives are finite differences of rollouts: one for each command, from the
step on in which the command acts. Limits of commands and of their changes are kept by
Hildreth's dual method (a quadratic program with few active constraints). Double precision, no allocation.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.jit import block_function, kernel_function, scalar_function
from disco_hw.model.coefficients import Base, Coefficients, Integration, base_point, effect_point
from disco_hw.model.drift import MOVES_RAD_S
from disco_hw.model.step import axle_of, delay_steps, in_force, integration_from, step, tracked_of

# Left and right, as of `disco_hw.control.kernel`.
CHANNELS = 2
# Residuals of one step: the distance to the reference along x and y. At the end comes one of the last heading.
RESIDUALS = 2
DIFFERENCE_RAD_S = 1e-3
# Of the diagonal of the normal matrix: keeps it positive definite where a command does nothing.
DAMPING = 1e-6
SWEEPS = 30
FEASIBLE_RAD_S = 1e-6
# Shares of a Gauss-Newton step that are tried until one costs less.
HALVINGS = 3
AXLE_X, AXLE_Y, COS, SIN, LEFT, RIGHT, CARRIED, X, Y, LAGGING = range(10)
STATE_COLUMNS = 10

Array = NDArray[Any]


class LateralLag(NamedTuple):
    """Lag of a body's sideways speed behind its turning, in steps that all last as long.

    At the start it goes with the turning. In a step the yaw rate that it goes with comes nearer to the wheels' by
    `share`, and the body misses a way aside as long as it slides in `missing_s` at the difference.
    """

    share: float
    missing_s: float

    @classmethod
    def of(cls, lag_s: float, step_s: float) -> LateralLag:
        """Return the lag of `lag_s`, of which none is 0."""
        share = -math.expm1(-step_s / lag_s) if lag_s > 0.0 else 1.0
        return cls(share, lag_s * share)


class Problem(NamedTuple):
    """Least-squares problem of a refinement: initial state, model coefficients, command bounds and reference.

    `start` (5,): x, y (m, relative to the task's origin), yaw (rad), wheel speeds (rad/s); `time_s` of it; `drift` (2,)
    of the ground (m/s); `lateral`: how the body's sideways speed lags; `means` (n,) of what the model's terms remember
    at the start, or None; `base`,
    `effects` (tables of one point), `series`: coefficients. `history`: rows of commands from before the plan.
    `reference` (T, 2) in m. `largest`, `change`: bounds of a command and of its change in a step (rad/s); `before`
    (2,): the command before the plan; `change_m`: distance (m) that costs as much as a change of 1 rad/s.
    `heading` (2,): the direction in which a robot that stays on the line faces at the end; `end_weight`: of the last
    squared distance, beside 1 for each step; `turn_m`: distance (m) that costs as much as a last heading across.
    """

    start: Array
    time_s: float
    drift: Array
    lateral: LateralLag
    means: Array | None
    base: Base
    effects: Coefficients
    series: Array
    history: int
    reference: Array
    largest: float
    change: float
    before: Array
    change_m: float
    heading: Array
    end_weight: float
    turn_m: float


class Buffers(NamedTuple):
    """Scratch of the refinement: T steps, N = 2 T commands, H rows of history.

    `commands` (H + T, 2): the past and the plan that is improved; `tried` the same for what is tried.
    `starts` (2, T, 2): plans to begin from.
    `states`, `moved` (T + 1, 10); `remembered` (n,) or None; `residuals` (2 T + 1,), `slopes` (N, 2 T + 1);
    `normal`, `inverse` (N, N); `gradient`, `step` (N,); `multipliers` (2, 2 N).
    """

    commands: Array
    tried: Array
    starts: Array
    states: Array
    moved: Array
    remembered: Array | None
    residuals: Array
    slopes: Array
    normal: Array
    inverse: Array
    gradient: Array
    step: Array
    multipliers: Array


@block_function
def _fill(row: Array, value: float) -> None:
    """Set all numbers of a row: by a loop, as numba takes a second to compile a kernel's assignments to slices."""
    for n in range(row.shape[0]):
        row[n] = value


@block_function
def _copy(source: Array, target: Array) -> None:
    """Copy rows of commands (N, 2), by a loop as `_fill`."""
    for n in range(source.shape[0]):
        for c in range(CHANNELS):
            target[n, c] = source[n, c]


@block_function
def _begin(states: Array, start: Array, base: Base) -> None:
    """Set row 0 of the states to the start."""
    cos_yaw, sin_yaw = math.cos(start[2]), math.sin(start[2])
    states[0, AXLE_X], states[0, AXLE_Y] = axle_of(start[0], start[1], cos_yaw, sin_yaw, base)
    states[0, COS], states[0, SIN] = cos_yaw, sin_yaw
    states[0, LEFT], states[0, RIGHT], states[0, CARRIED] = start[3], start[4], 0.0
    states[0, LAGGING] = 2.0 * base.half_turn_ratio * (start[4] - start[3])


@block_function
def _roll(
    states: Array, first: int, commands: Array, history: int, time_s: float, drift: Array, lateral: LateralLag,
    remembered: Array | None, base: Base, effects: Coefficients, integration: Integration,
) -> None:  # fmt: skip
    """Fill the rows of `states` behind row `first` from that row.

    `first` is no literal, for which numba would compile a form of its own.
    """
    first_input = history - delay_steps(effects)
    for t in range(first, states.shape[0] - 1):
        recent, older = max(t + first_input, 0), max(t + first_input - 1, 0)
        left = in_force(commands[recent, 0], commands[older, 0], effects)
        right = in_force(commands[recent, 1], commands[older, 1], effects)
        was_left, was_right = states[t, LEFT], states[t, RIGHT]
        axle_x, axle_y, cos_yaw, sin_yaw, wheel_left, wheel_right, _, half_rate = step(
            states[t, AXLE_X], states[t, AXLE_Y], states[t, COS], states[t, SIN], was_left, was_right, left, right,
            time_s + t * integration.step_s, base, effects, integration, remembered,
        )  # fmt: skip
        turning = 0.5 * (abs(wheel_left + was_left) + abs(wheel_right + was_right))
        carried_s = states[t, CARRIED] + min(turning / MOVES_RAD_S, 1.0) * integration.step_s
        ahead = 2.0 * half_rate - states[t, LAGGING]
        missing_m = base.x_icr_m * ahead * lateral.missing_s
        axle_x -= missing_m * 0.5 * (states[t, SIN] + sin_yaw)
        axle_y += missing_m * 0.5 * (states[t, COS] + cos_yaw)
        states[t + 1, LAGGING] = states[t, LAGGING] + ahead * lateral.share
        x, y = tracked_of(axle_x, axle_y, cos_yaw, sin_yaw, base)
        states[t + 1, AXLE_X], states[t + 1, AXLE_Y] = axle_x, axle_y
        states[t + 1, COS], states[t + 1, SIN] = cos_yaw, sin_yaw
        states[t + 1, LEFT], states[t + 1, RIGHT], states[t + 1, CARRIED] = wheel_left, wheel_right, carried_s
        states[t + 1, X] = x + carried_s * drift[0]
        states[t + 1, Y] = y + carried_s * drift[1]


@block_function
def _store_memory(remembered: Array | None, means: Array | None) -> None:
    """Set what the model's terms remember to what they do at the start."""
    if remembered is None or means is None:
        return
    for n in range(remembered.shape[0]):
        remembered[n] = means[n]


@scalar_function
def _residual(problem: Problem, states: Array, t: int) -> tuple[float, float]:
    """Residuals of step t: the distance to the reference along x and y (m), of the last step weighted."""
    off_x, off_y = states[t + 1, X] - problem.reference[t, 0], states[t + 1, Y] - problem.reference[t, 1]
    if t == problem.reference.shape[0] - 1:
        root = math.sqrt(problem.end_weight)
        return root * off_x, root * off_y
    return off_x, off_y


@scalar_function
def _last_residual(problem: Problem, states: Array) -> float:
    """Residual of the last heading (m)."""
    last = states.shape[0] - 1
    across = states[last, SIN] * problem.heading[0] - states[last, COS] * problem.heading[1]
    along = states[last, COS] * problem.heading[0] + states[last, SIN] * problem.heading[1]
    return problem.turn_m * math.sqrt(problem.end_weight) * 2.0 * math.atan2(across, 1.0 + max(along, -0.99))


@block_function
def _cost(problem: Problem, buffers: Buffers, commands: Array) -> float:
    """Cost of commands (H + T, 2)."""
    integration = integration_from(problem.series, True, None)
    states, history = buffers.states, problem.history
    base, effects = base_point(problem.base, 0), effect_point(problem.effects, 0)
    _store_memory(buffers.remembered, problem.means)
    _begin(states, problem.start, base)
    _roll(
        states, np.int64(0), commands, history, problem.time_s, problem.drift, problem.lateral, buffers.remembered,
        base, effects, integration,
    )  # fmt: skip
    turned = _last_residual(problem, states)
    cost = turned * turned
    for t in range(problem.reference.shape[0]):
        off_x, off_y = _residual(problem, states, t)
        cost += off_x * off_x + off_y * off_y
    changes = 0.0
    for t in range(problem.reference.shape[0]):
        for c in range(CHANNELS):
            last = problem.before[c] if t == 0 else commands[history + t - 1, c]
            changed = commands[history + t, c] - last
            changes += changed * changed
    return cost + problem.change_m * problem.change_m * changes


@block_function
def _linearise(problem: Problem, buffers: Buffers) -> None:
    """Set the normal matrix and the gradient (of half the cost) at `buffers.commands`."""
    integration = integration_from(problem.series, True, None)
    states, moved, commands, history = buffers.states, buffers.moved, buffers.commands, problem.history
    steps = problem.reference.shape[0]
    size = CHANNELS * steps
    normal, gradient, slopes, residuals = buffers.normal, buffers.gradient, buffers.slopes, buffers.residuals
    base, effects = base_point(problem.base, 0), effect_point(problem.effects, 0)
    _store_memory(buffers.remembered, problem.means)
    _begin(states, problem.start, base)
    _roll(
        states, np.int64(0), commands, history, problem.time_s, problem.drift, problem.lateral, buffers.remembered,
        base, effects, integration,
    )  # fmt: skip
    for t in range(steps):
        residuals[RESIDUALS * t], residuals[RESIDUALS * t + 1] = _residual(problem, states, t)
    residuals[size] = _last_residual(problem, states)
    for j in range(size):
        k, c = j // CHANNELS, j % CHANNELS
        # What terms remember is not kept along a rollout: with such it is rolled out from its start.
        first = 0 if buffers.remembered is not None else k
        _store_memory(buffers.remembered, problem.means)
        for column in range(STATE_COLUMNS):
            moved[first, column] = states[first, column]
        moved[0, AXLE_X], moved[0, AXLE_Y] = states[0, AXLE_X], states[0, AXLE_Y]
        kept = commands[history + k, c]
        commands[history + k, c] = kept + DIFFERENCE_RAD_S
        _roll(
            moved, first, commands, history, problem.time_s, problem.drift, problem.lateral, buffers.remembered, base,
            effects, integration,
        )  # fmt: skip
        commands[history + k, c] = kept
        for t in range(k, steps):
            off_x, off_y = _residual(problem, moved, t)
            slopes[j, RESIDUALS * t] = (off_x - residuals[RESIDUALS * t]) / DIFFERENCE_RAD_S
            slopes[j, RESIDUALS * t + 1] = (off_y - residuals[RESIDUALS * t + 1]) / DIFFERENCE_RAD_S
        slopes[j, size] = (_last_residual(problem, moved) - residuals[size]) / DIFFERENCE_RAD_S
    for a in range(size):
        begin = RESIDUALS * (a // CHANNELS)
        pulled = 0.0
        for r in range(begin, size + 1):
            pulled += slopes[a, r] * residuals[r]
        gradient[a] = pulled
        for b in range(a + 1):
            product = 0.0
            for r in range(begin, size + 1):
                product += slopes[a, r] * slopes[b, r]
            normal[a, b] = product
    _add_changes(problem, buffers)
    for a in range(size):
        normal[a, a] += DAMPING * normal[a, a] + 1e-12


@block_function
def _add_changes(problem: Problem, buffers: Buffers) -> None:
    """Add the changes of the commands to the normal matrix and the gradient."""
    commands, history = buffers.commands, problem.history
    weight = problem.change_m * problem.change_m
    for t in range(problem.reference.shape[0]):
        for c in range(CHANNELS):
            j = CHANNELS * t + c
            last = problem.before[c] if t == 0 else commands[history + t - 1, c]
            changed = weight * (commands[history + t, c] - last)
            buffers.normal[j, j] += weight
            buffers.gradient[j] += changed
            if t > 0:
                buffers.normal[j - CHANNELS, j - CHANNELS] += weight
                buffers.normal[j, j - CHANNELS] -= weight
                buffers.gradient[j - CHANNELS] -= changed


@block_function
def _factorise(normal: Array) -> None:
    """Replace the lower half of a positive definite matrix by its Cholesky factor."""
    for a in range(normal.shape[0]):
        for b in range(a + 1):
            rest = normal[a, b]
            for r in range(b):
                rest -= normal[a, r] * normal[b, r]
            normal[a, b] = math.sqrt(max(rest, 1e-18)) if a == b else rest / normal[b, b]


@block_function
def _solve(factor: Array, vector: Array) -> None:
    """Replace a vector by the solution of the factorised system."""
    size = factor.shape[0]
    for a in range(size):
        rest = vector[a]
        for b in range(a):
            rest -= factor[a, b] * vector[b]
        vector[a] = rest / factor[a, a]
    for a in range(size - 1, -1, -1):
        vector[a] /= factor[a, a]
        for b in range(a):
            vector[b] -= factor[a, b] * vector[a]


@block_function
def _violation(problem: Problem, buffers: Buffers) -> float:
    """Return by how much the commands with the step exceed a limit at most (rad/s)."""
    commands, history, worst = buffers.commands, problem.history, 0.0
    for t in range(problem.reference.shape[0]):
        for c in range(CHANNELS):
            command = commands[history + t, c] + buffers.step[CHANNELS * t + c]
            last = problem.before[c]
            if t > 0:
                last = commands[history + t - 1, c] + buffers.step[CHANNELS * (t - 1) + c]
            worst = max(worst, abs(command) - problem.largest, abs(command - last) - problem.change)
    return worst


@block_function
def _move_within(problem: Problem, buffers: Buffers) -> None:
    """Change the step to the optimum within the limits: Hildreth's method, one multiplier for each limit."""
    size = buffers.step.shape[0]
    inverse, step_, multipliers = buffers.inverse, buffers.step, buffers.multipliers
    commands, history = buffers.commands, problem.history
    for a in range(size):
        _fill(inverse[a], 0.0)
        inverse[a, a] = 1.0
        _solve(buffers.normal, inverse[a])
    for side in range(2):
        _fill(multipliers[side], 0.0)
    for _ in range(SWEEPS):
        for row in range(2 * size):
            # Rows below `size` bound a command, those above its change.
            j = row % size
            t, c = j // CHANNELS, j % CHANNELS
            value = commands[history + t, c] + step_[j]
            slope, bound = inverse[j, j], problem.largest
            pair = -1
            if row >= size:
                bound = problem.change
                if t == 0:
                    value -= problem.before[c]
                else:
                    pair = j - CHANNELS
                    value -= commands[history + t - 1, c] + step_[pair]
                    slope += inverse[pair, pair] - 2.0 * inverse[j, pair]
            for side in range(2):
                sign = 1.0 if side == 0 else -1.0
                more = max((sign * value - bound) / slope, -multipliers[side, row])
                if more == 0.0:
                    continue
                multipliers[side, row] += more
                value -= sign * more * slope
                for a in range(size):
                    moved = inverse[j, a] if pair < 0 else inverse[j, a] - inverse[pair, a]
                    step_[a] -= sign * more * moved


@block_function
def _apply_step(problem: Problem, buffers: Buffers, share: float) -> None:
    """Set `tried` to the commands with this share of the step, within the limits exactly."""
    history = problem.history
    for row in range(history):
        for c in range(CHANNELS):
            buffers.tried[row, c] = buffers.commands[row, c]
    for c in range(CHANNELS):
        last = problem.before[c]
        for t in range(problem.reference.shape[0]):
            command = buffers.commands[history + t, c] + share * buffers.step[CHANNELS * t + c]
            command = min(max(command, last - problem.change), last + problem.change)
            last = min(max(command, -problem.largest), problem.largest)
            buffers.tried[history + t, c] = last


@block_function
def _choose_start(problem: Problem, buffers: Buffers, count: int) -> float:
    """Set the plan to the cheapest of the first `count` starts, brought within the limits; returns its cost."""
    plan, starts = buffers.commands[problem.history :], buffers.starts
    best, least = 0, math.inf
    _fill(buffers.step, 0.0)
    for n in range(count):
        _copy(starts[n], plan)
        _apply_step(problem, buffers, 0.0)
        _copy(buffers.tried[problem.history :], starts[n])
        cost = _cost(problem, buffers, buffers.tried)
        if cost < least:
            best, least = n, cost
    _copy(starts[best], plan)
    return least


@kernel_function
def refine(problem: Problem, buffers: Buffers, count: int, iterations: int) -> float:
    """Improve the cheapest of the first `count` of `buffers.starts`, in `buffers.commands`; returns its cost."""
    cost = _choose_start(problem, buffers, count)
    if cost == math.inf:
        return cost
    for _ in range(iterations):
        _linearise(problem, buffers)
        for a in range(buffers.step.shape[0]):
            buffers.step[a] = -buffers.gradient[a]
        _factorise(buffers.normal)
        _solve(buffers.normal, buffers.step)
        if _violation(problem, buffers) > FEASIBLE_RAD_S:
            _move_within(problem, buffers)
        share, improved = 1.0, False
        for _ in range(HALVINGS):
            _apply_step(problem, buffers, share)
            tried = _cost(problem, buffers, buffers.tried)
            if tried < cost:
                cost, improved = tried, True
                _copy(buffers.tried, buffers.commands)
                break
            share *= 0.5
        if not improved:
            break
    return cost
