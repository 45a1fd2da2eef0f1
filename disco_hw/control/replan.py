"""One step of DISCO, compiled: shift the last plan, sample, roll out, weigh, update. Nothing is allocated."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from disco_hw.control.blocks import BLOCK, PAIR, U
from disco_hw.control.random_numbers import fill_normal_block
from disco_hw.control.rollout import expand, roll_block
from disco_hw.control.weighting import refuse_invalid, temperature_for, weigh
from disco_hw.model.jit import block_function, float32, kernel_function, prefer_wide_vectors


class Workspace(NamedTuple):
    """Buffers of the step, float32 and flat unless said.

    `nominal` (T, 2), `updated` (T, 2), `knots` (blocks, R, 2, BLOCK), `commands` (H + T, 2, BLOCK), `state`,
    `point_costs` (L, K'), `costs` (K'), `weights` (K'), `sums` (T, 2, BLOCK), with K' = blocks * BLOCK;
    `report` (6,) float64: ess, temperature, least, mean and nominal cost, number of finite costs.
    """

    nominal: Any
    updated: Any
    knots: Any
    commands: Any
    state: Any
    point_costs: Any
    costs: Any
    weights: Any
    sums: Any
    report: Any


class Sampling(NamedTuple):
    """What is sampled: seed and step number, samples, blocks, rows of knots, noise, temperature or 0, target ESS."""

    seed: Any
    step: Any
    samples: Any
    blocks: Any
    rows: Any
    noise_std: Any
    temperature: Any
    target_ess: Any


@block_function
def shift(nominal: Any, scratch: Any, steps: float) -> None:
    """Move the sequence (T, 2) on by a fraction of steps; what is beyond its end holds the last command."""
    horizon = nominal.shape[0]
    for t in range(horizon):
        position = min(t + steps, float(horizon - 1))
        index = min(int(position), horizon - 2)
        fraction = float32(position - index)
        for side in range(2):
            scratch[t, side] = nominal[index, side] + fraction * (nominal[index + 1, side] - nominal[index, side])
    for t in range(horizon):
        for side in range(2):
            nominal[t, side] = scratch[t, side]


@block_function
def mean_over_points(costs: Any, point_costs: Any, point_weights: Any, samples: int) -> None:
    """Costs of the samples as weighted means over the parameter points."""
    prefer_wide_vectors()
    for k in range(U(samples)):
        costs[k] = point_weights[0] * point_costs[k]
    for i in range(1, point_weights.size):
        weight = point_weights[i]
        first = U(i * samples)
        for k in range(U(samples)):
            costs[k] += weight * point_costs[first + k]


@block_function
def add_weighted(sums: Any, weights: Any, first: Any, commands: Any, history: int, horizon: int) -> None:
    """Add one block's commands times its weights to `sums`."""
    prefer_wide_vectors()
    for j in range(U(2 * horizon)):
        to, source = j * BLOCK, U(history) * PAIR + j * BLOCK
        for b in range(BLOCK):
            sums[to + b] += weights[first + b] * commands[source + b]


@kernel_function
def replan(  # noqa: PLR0912
    workspace: Any, sampling: Any, history: int, shift_steps: float, basis: Any, limits: Any, start: Any, base: Any,
    effects: Any, point_weights: Any, integration: Any, task: Any, memory: float,
) -> bool:  # fmt: skip
    """One step of DISCO on `workspace.nominal`; False (and no update) if no sample has a finite cost."""
    nominal, horizon = workspace.nominal, workspace.nominal.shape[0]
    blocks = sampling.blocks
    padded = blocks * int(BLOCK)
    points = point_weights.size
    shift(nominal, workspace.updated, shift_steps)
    for block in range(blocks):
        fill_normal_block(workspace.knots, sampling.rows, block, sampling.step, sampling.seed, sampling.noise_std)
        first_knot = U(block * sampling.rows) * PAIR
        if block == 0:
            for j in range(U(2 * sampling.rows)):
                workspace.knots[j * BLOCK] = float32(0.0)
        expand(workspace.commands, workspace.state, history, nominal, workspace.knots, first_knot, basis, limits)
        roll_block(
            workspace.point_costs, points, padded, block, horizon, workspace.commands, workspace.state, history,
            start, base, effects, integration, task, memory,
        )  # fmt: skip
    costs = workspace.costs
    mean_over_points(costs, workspace.point_costs, point_weights, padded)
    report = workspace.report
    report[4] = costs[0]
    least, valid = refuse_invalid(costs, sampling.samples)
    report[5] = valid
    if valid == 0:
        return False
    total_cost = 0.0
    for k in range(U(sampling.samples)):
        if costs[k] < float32(1e30):
            total_cost += costs[k]
    if sampling.temperature > float32(0.0):
        temperature = sampling.temperature
        total, size = weigh(workspace.weights, workspace.state, costs, blocks, sampling.samples, least, temperature)
    else:
        target = min(sampling.target_ess, float32(valid))
        temperature, total, size = temperature_for(
            target, workspace.weights, workspace.state, costs, blocks, sampling.samples, least, report[1]
        )
    report[0], report[1], report[2], report[3] = size, temperature, least, total_cost / valid

    sums = workspace.sums
    for j in range(U(horizon) * PAIR):
        sums[j] = float32(0.0)
    for block in range(blocks):
        first_knot = U(block * sampling.rows) * PAIR
        expand(workspace.commands, workspace.state, history, nominal, workspace.knots, first_knot, basis, limits)
        add_weighted(sums, workspace.weights, U(block) * BLOCK, workspace.commands, history, horizon)
    finite = True
    for t in range(horizon):
        for side in range(2):
            row = U(2 * t + side) * BLOCK
            value = float32(0.0)
            for b in range(BLOCK):
                value += sums[row + b]
            value /= total
            workspace.updated[t, side] = value
            finite &= math.isfinite(value)
    if not finite:
        return False
    for t in range(horizon):
        for side in range(2):
            nominal[t, side] = workspace.updated[t, side]
    return True
