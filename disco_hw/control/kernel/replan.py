"""One step of DISCO, compiled: shift the last plan, sample, roll out, weigh, update. Nothing is allocated."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from disco_hw.control.kernel.blocks import BLOCK, U
from disco_hw.control.kernel.random_numbers import fill_normal_block
from disco_hw.control.kernel.risk import mean_over_points, worst_over_points
from disco_hw.control.kernel.rollout import roll_block
from disco_hw.control.kernel.sequences import (
    add_control_cost,
    add_drawn_control_cost,
    add_weighted,
    expand,
    mean_noise,
    pull_on_knots,
    sum_lanes,
)
from disco_hw.control.kernel.weighting import INVALID, refuse_invalid, temperature_for, weigh
from disco_hw.jit import block_function, float32, kernel_function

ESS, TEMPERATURE, LEAST, MEAN, NOMINAL, VALID = range(6)


class Workspace(NamedTuple):
    """Buffers of the step, float32 and flat unless said; C channels, R rows of noise, K' = blocks * BLOCK samples.

    `nominal`, `updated`, `before_update` (T, C); `noise` (blocks, R, BLOCK); `commands` (blocks or 1,
    (H + T) * C * BLOCK); `state` (STATE_ROWS, BLOCK); `point_costs` (L, K'); `costs`, `weights` (K',); `sums`
    (T * C or R, BLOCK); `pull` (R,); `order` (L,) int64; `report` (6,) float64: effective sample size, temperature,
    least, mean and nominal cost, number of finite costs.
    """

    nominal: Any
    updated: Any
    before_update: Any
    noise: Any
    commands: Any
    state: Any
    point_costs: Any
    costs: Any
    weights: Any
    sums: Any
    pull: Any
    order: Any
    report: Any


# How is sampled and weighed. `with_nominal`: sample 0 is the nominal. `hold`: a shifted plan ends in its last command,
# else in zero. `drawn`: the update is made from the noise as drawn, else as applied. `temperature` is 0 for
# `target_ess`. `control_cost`: weight over variance. `worst_part`: of the points' weight that the cost is the mean of.
# `kept`: all blocks' commands are kept from the rollout for the update, else worked out again.
SAMPLING = np.dtype(
    [
        ("seed", "i8"),
        ("samples", "i8"),
        ("blocks", "i8"),
        ("rows", "i8"),
        ("history", "i8"),
        ("kept", "?"),
        ("with_nominal", "?"),
        ("hold", "?"),
        ("drawn", "?"),
        ("noise_std", "f4"),
        ("temperature", "f4"),
        ("target_ess", "f4"),
        ("control_cost", "f4"),
        ("worst_part", "f4"),
    ],
    align=True,
)


@block_function
def shift(nominal: Any, scratch: Any, steps: float, hold: bool) -> None:
    """Move the sequence (T, C) on by a fraction of steps; beyond its end it holds the last command or is zero."""
    horizon, channels = nominal.shape
    whole = int(min(steps, float(horizon)))
    fraction = float32(min(steps - whole, 1.0))
    for t in range(horizon):
        at, after = min(t + whole, horizon - 1), min(t + whole + 1, horizon - 1)
        for c in range(channels):
            first, second = nominal[at, c], nominal[after, c]
            if not hold:
                first = first if t + whole < horizon else float32(0.0)
                second = second if t + whole + 1 < horizon else float32(0.0)
            scratch[t, c] = first + fraction * (second - first)
    for t in range(horizon):
        for c in range(channels):
            nominal[t, c] = scratch[t, c]


@block_function
def sample_and_roll(work: Any, sampling: Any, step: int, basis: Any, limits: Any, system: Any, points: int) -> None:
    """Draw all samples and cost them: writes `noise`, `point_costs` and, as far as the control cost goes, `costs`."""
    nominal, history = work.nominal, sampling.history
    horizon = nominal.shape[0]
    padded = sampling.blocks * int(BLOCK)
    charged = sampling.control_cost > float32(0.0)
    if charged and sampling.drawn:
        pull_on_knots(work.pull, nominal, basis)
    for block in range(sampling.blocks):
        fill_normal_block(work.noise, sampling.rows, block, step, sampling.seed, sampling.noise_std)
        first_noise, first = U(block * sampling.rows) * BLOCK, U(block) * BLOCK
        commands = work.commands[block if sampling.kept else 0]
        if block == 0 and sampling.with_nominal:
            for j in range(U(sampling.rows)):
                work.noise[j * BLOCK] = float32(0.0)
        for b in range(BLOCK):
            work.costs[first + b] = float32(0.0)
        expand(commands, work.state, history, nominal, work.noise, first_noise, basis, limits)
        if charged and sampling.drawn:
            add_drawn_control_cost(work.costs, first, work.noise, first_noise, work.pull, sampling.control_cost)
        elif charged:
            add_control_cost(work.costs, first, commands, history, nominal, sampling.control_cost)
        roll_block(system, work.point_costs, points, padded, block, horizon, commands, work.state)


@block_function
def weigh_all(work: Any, sampling: Any) -> Any:
    """Weights from costs; fills the report. Returns the sum of the weights, or 0 if no cost is finite.

    Without a finite cost the effective sample size is 0, and there is no least and no mean cost.
    """
    costs, report = work.costs, work.report
    report[NOMINAL] = costs[0]
    least, valid = refuse_invalid(costs, sampling.samples)
    report[VALID] = valid
    if valid == 0:
        report[ESS], report[LEAST], report[MEAN] = 0.0, math.nan, math.nan
        return float32(0.0)
    total_cost = 0.0
    for k in range(U(sampling.samples)):
        if costs[k] < INVALID:
            total_cost += costs[k]
    if sampling.temperature > float32(0.0):
        temperature = sampling.temperature
        total, size = weigh(work.weights, work.state, costs, sampling.blocks, sampling.samples, least, temperature)
    else:
        target = min(sampling.target_ess, float32(valid))
        temperature, total, size = temperature_for(
            target, work.weights, work.state, costs, sampling.blocks, sampling.samples, least, report[TEMPERATURE]
        )
    report[ESS], report[TEMPERATURE], report[LEAST], report[MEAN] = size, temperature, least, total_cost / valid
    return total


@block_function
def update(work: Any, sampling: Any, basis: Any, limits: Any, total: float, gain: float) -> Any:
    """Move `nominal` by `gain` towards the weighted mean of the samples' commands; False if that is not finite."""
    nominal, sums = work.nominal, work.sums
    horizon, channels = nominal.shape
    rows = sampling.rows if sampling.drawn else horizon * channels
    for j in range(U(rows) * BLOCK):
        sums[j] = float32(0.0)
    skip = U(sampling.history * channels)
    if sampling.drawn:
        add_weighted(sums, work.weights, U(0), sampling.blocks, work.noise, U(rows) * BLOCK, U(0), rows)
    elif sampling.kept:
        commands = work.commands.reshape(work.commands.size)
        add_weighted(sums, work.weights, U(0), sampling.blocks, commands, U(work.commands.shape[1]), skip, rows)
    else:
        commands = work.commands[0]
        for block in range(sampling.blocks):
            first_noise = U(block * sampling.rows) * BLOCK
            expand(commands, work.state, sampling.history, nominal, work.noise, first_noise, basis, limits)
            add_weighted(sums, work.weights, U(block), 1, commands, U(0), skip, rows)
    sum_lanes(sums, rows)
    finite = True
    for t in range(horizon):
        for c in range(channels):
            if sampling.drawn:
                value = gain * (mean_noise(sums, t, c, channels, basis) / total)
            else:
                value = gain * (sums[U(t * channels + c) * BLOCK] / total - nominal[t, c])
            value += nominal[t, c]
            work.updated[t, c] = min(max(value, -limits.largest), limits.largest)
            finite &= math.isfinite(value)
    if finite:
        for t in range(horizon):
            for c in range(channels):
                work.before_update[t, c] = nominal[t, c]
                nominal[t, c] = work.updated[t, c]
    return finite


@kernel_function
def replan(
    work: Any,
    samplings: Any,
    step: int,
    shift_steps: float,
    gain: float,
    basis: Any,
    limits: Any,
    system: Any,
    point_weights: Any,
) -> Any:
    """One step of DISCO on `work.nominal`; False, and the shifted plan stays, if nothing valid came out.

    `samplings` (1,) of SAMPLING; `limits` bound the commands; `system` is what is rolled out.
    """
    sampling = samplings[0]
    shift(work.nominal, work.updated, shift_steps, sampling.hold)
    sample_and_roll(work, sampling, step, basis, limits, system, point_weights.size)
    if sampling.worst_part < float32(1.0):
        worst_over_points(work.costs, work.point_costs, point_weights, sampling.blocks, sampling.worst_part, work.order)
    else:
        mean_over_points(work.costs, work.point_costs, point_weights, sampling.blocks)
    total = weigh_all(work, sampling)
    return total > float32(0.0) and update(work, sampling, basis, limits, total, float32(gain))
