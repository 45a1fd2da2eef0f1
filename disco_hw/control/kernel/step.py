"""One step of DISCO, compiled: Algorithm 1 of the paper. Start reading at `disco_step`. Nothing is allocated.

Below it, from costs to weights: risk over parameter points, then softmax with a given or adapted temperature. Sums run
over lanes in a fixed order, so that the same costs give the same weights bit for bit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import BLOCK, Floats, System, U, roll_block
from disco_hw.control.kernel.sequences import (
    Basis,
    Limits,
    add_control_cost,
    add_sampled_control_cost,
    add_weighted,
    expand,
    fill_normal_block,
    mean_noise,
    pull_on_knots,
    row_sum,
    sum_lanes,
)
from disco_hw.jit import (
    block_function,
    cast_like,
    float32,
    float_from_bits,
    int32,
    kernel_function,
    scalar_function,
    tune_loops,
)
from disco_hw.tasks import single

ESS, TEMPERATURE, LEAST, MEAN, NOMINAL, VALID = range(6)


class Workspace(NamedTuple):
    """Buffers of the step, float32 and flat unless said; C channels, R rows of noise, K' = blocks * BLOCK samples.

    `nominal` (T, C) is U of the paper; `guide` (T, C), commands within the limits for sample 1; `updated`,
    `before_update` (T, C); `noise` (blocks, R, BLOCK), E of the paper;
    `commands` (blocks, (H + T) * C * BLOCK), V of the paper behind H steps from before the plan; `state`
    (STATE_ROWS, BLOCK); `point_costs` (L, K'), S_i^k; `costs`, `weights` (K',), S^k and w_k; `sums`
    (T * C or R, BLOCK); `pull` (R,); `order` (L,) int64; `report` (6,) float64: effective sample size, temperature,
    least, mean and nominal cost, number of finite costs.
    """

    nominal: Floats
    guide: Floats
    updated: Floats
    before_update: Floats
    noise: Floats
    commands: Floats
    state: Floats
    point_costs: Floats
    costs: Floats
    weights: Floats
    sums: Floats
    pull: Floats
    order: NDArray[np.int64]
    report: NDArray[np.float64]


# How is sampled and weighed. `with_nominal`: sample 0 is the nominal. `with_guide`: sample 1 is the guide. `hold`: a
# shifted plan ends in its last command, else in zero. `drawn`: the update is made from the noise as drawn, else as
# applied. `temperature` is 0 for `target_ess`. `control_cost`: weight over variance. `worst_part`: of the points'
# weight that the cost is the mean of.
SAMPLING = np.dtype(
    [
        ("seed", "i8"),
        ("samples", "i8"),
        ("blocks", "i8"),
        ("rows", "i8"),
        ("history", "i8"),
        ("with_nominal", "?"),
        ("with_guide", "?"),
        ("hold", "?"),
        ("drawn", "?"),
        ("noise_std", "f4"),
        ("wide", "f4"),
        ("temperature", "f4"),
        ("target_ess", "f4"),
        ("control_cost", "f4"),
        ("worst_part", "f4"),
    ],
    align=True,
)
Sampling = np.record
# The lanes of a block from this one on are drawn `wide` times as wide: a fifth of all samples.
WIDE_FROM = U(64)


@kernel_function
def disco_step(
    work: Workspace, samplings: NDArray[np.void], step: int, shift_steps: float, gain: float, basis: Basis,
    limits: Limits, system: System, point_weights: Floats,
) -> bool:  # fmt: skip
    """One pass through the loop of Algorithm 1, on the plan `work.nominal`; equations are numbered as in the paper.

    False, and the shifted plan stays, if no sample has a finite cost. `samplings` (1,) of SAMPLING; `limits` bound the
    commands; `system` is f_theta with its parameter points and the task; `point_weights` (L,) the points' weights.
    """
    sampling = samplings[0]
    # RollControlActions: here by the time that has passed since the last step.
    shift(work.nominal, work.updated, shift_steps, sampling.hold)
    if charges_sampled(sampling):
        pull_on_knots(work.pull, work.nominal, basis)
    for block in range(sampling.blocks):
        # Sample E^k, eps ~ N(0, Sigma), and V = U + E within the limits.
        sample(work, sampling, step, block, basis, limits)
        # lambda sum_t u_t' Sigma^-1 eps_t, of (9).
        charge(work, sampling, block)
        # Roll out f_theta (2) under every parameter point: S_theta(V) = phi + sum_t c, (5), for each k and i.
        roll_block(
            system, work.point_costs, point_weights.size, sampling.blocks * int(BLOCK), block, work.nominal.shape[0],
            work.commands[block], work.state,
        )  # fmt: skip
    # S(V) = sum_i w_i^m S_theta(V; chi_i), (17); or the mean over its worst part.
    if sampling.worst_part < float32(1.0):
        worst_over_points(work.costs, work.point_costs, point_weights, sampling.blocks, sampling.worst_part, work.order)
    else:
        mean_over_points(work.costs, work.point_costs, point_weights, sampling.blocks)
    # w_k = exp(-(S^k - rho) / lambda), and eta, their sum: (9) and (10).
    eta = weigh_all(work, sampling)
    # u_t += sum_k w_k eps_t^k / eta.
    return eta > float32(0.0) and update(work, sampling, basis, limits, eta, float32(gain))


@block_function
def shift(nominal: Floats, scratch: Floats, steps: float, hold: bool) -> None:
    """Move the sequence (T, C) on by a fraction of steps; beyond its end it holds the last command or is zero."""
    horizon, channels = nominal.shape
    steps_ahead = int(min(steps, float(horizon)))
    fraction = float32(min(steps - steps_ahead, 1.0))
    for t in range(horizon):
        at, after = min(t + steps_ahead, horizon - 1), min(t + steps_ahead + 1, horizon - 1)
        for c in range(channels):
            first, second = nominal[at, c], nominal[after, c]
            if not hold:
                first = first if t + steps_ahead < horizon else float32(0.0)
                second = second if t + steps_ahead + 1 < horizon else float32(0.0)
            scratch[t, c] = first + fraction * (second - first)
    for t in range(horizon):
        for c in range(channels):
            nominal[t, c] = scratch[t, c]


@block_function
def charges_sampled(sampling: Sampling) -> bool:
    """Whether the control cost is of the noise as drawn."""
    return sampling.drawn and sampling.control_cost > float32(0.0)


@block_function
def sample(work: Workspace, sampling: Sampling, step: int, block: int, basis: Basis, limits: Limits) -> None:
    """Draw the noise of a block of samples and make their command sequences of it."""
    first_noise = U(block * sampling.rows) * BLOCK
    fill_normal_block(work.noise, sampling.rows, block, step, sampling.seed, sampling.noise_std)
    if sampling.wide > float32(1.0):
        for j in range(U(sampling.rows)):
            for b in range(WIDE_FROM, BLOCK):
                work.noise[first_noise + j * BLOCK + b] *= sampling.wide
    if block == 0 and sampling.with_nominal:
        for j in range(U(sampling.rows)):
            work.noise[j * BLOCK] = float32(0.0)
    expand(
        work.commands[block], work.state, sampling.history, work.nominal, work.noise, first_noise, basis, limits
    )  # fmt: skip
    if block == 0 and sampling.with_guide:
        horizon, channels = work.nominal.shape
        for t in range(horizon):
            for c in range(channels):
                work.commands[0, U((sampling.history + t) * channels + c) * BLOCK + U(1)] = work.guide[t, c]


@block_function
def charge(work: Workspace, sampling: Sampling, block: int) -> None:
    """Begin the costs of a block of samples with their control cost, or with zero."""
    first = U(block) * BLOCK
    for b in range(BLOCK):
        work.costs[first + b] = float32(0.0)
    if sampling.control_cost > float32(0.0):
        if sampling.drawn:
            first_noise = U(block * sampling.rows) * BLOCK
            add_sampled_control_cost(work.costs, first, work.noise, first_noise, work.pull, sampling.control_cost)
        else:
            add_control_cost(
                work.costs, first, work.commands[block], sampling.history, work.nominal, sampling.control_cost
            )  # fmt: skip


@block_function
def weigh_all(work: Workspace, sampling: Sampling) -> float:
    """Compute the samples' weights from their costs and fill the report.

    Returns the sum of the weights, or 0 if no cost is finite.

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
def update(
    work: Workspace, sampling: Sampling, basis: Basis, limits: Limits, total: float, gain: float
) -> bool:  # fmt: skip
    """Move `nominal` by `gain` towards the weighted mean of the samples' commands; False if that is not finite."""
    nominal, sums = work.nominal, work.sums
    horizon, channels = nominal.shape
    rows = sampling.rows if sampling.drawn else horizon * channels
    for j in range(U(rows) * BLOCK):
        sums[j] = float32(0.0)
    skip = U(sampling.history * channels)
    if sampling.drawn:
        add_weighted(sums, work.weights, U(0), sampling.blocks, work.noise, U(rows) * BLOCK, U(0), rows)
    else:
        commands = work.commands.reshape(work.commands.size)
        add_weighted(sums, work.weights, U(0), sampling.blocks, commands, U(work.commands.shape[1]), skip, rows)
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


_LOG2_E = np.float32(math.log2(math.e))
_LN2_HIGH = np.float32(0.693359375)
_LN2_LOW = np.float32(math.log(2.0) - 0.693359375)
_LOWEST = single(-87.0)
INVALID = single(1e30)

_SUM, _SQUARES = U(0), BLOCK


@scalar_function
def exp_nonpositive(value: float) -> float:
    """Exponential of a float32 <= 0, relative error below 3e-7; anything below -87 counts as -87."""
    value = value if value > _LOWEST else _LOWEST
    steps_ahead = int32(value * _LOG2_E - float32(0.5))
    rest = value - float32(steps_ahead) * _LN2_HIGH - float32(steps_ahead) * _LN2_LOW
    series = float32(1.0) + rest * (
        float32(1.0)
        + rest
        * (
            float32(1 / 2)
            + rest * (float32(1 / 6) + rest * (float32(1 / 24) + rest * (float32(1 / 120) + rest * float32(1 / 720))))
        )
    )
    return series * float_from_bits(int32(int32(steps_ahead + int32(127)) << int32(23)))


@block_function
def refuse_invalid(costs: Floats, samples: int) -> tuple[float, int]:
    """Replace costs that are not finite by INVALID; returns the least cost and the number of finite ones."""
    least, count = INVALID, 0
    for k in range(U(samples)):
        cost = costs[k]
        if cost < INVALID:
            count += 1
            least = min(least, cost)
        else:
            costs[k] = INVALID
    return least, count


@block_function
def weigh(
    weights: Floats, scratch: Floats, costs: Floats, blocks: int, samples: int, least: float, temperature: float
) -> tuple[float, float]:
    """Unnormalised weights exp(-(cost - least) / temperature); returns their sum and effective sample size.

    `scratch` holds two rows of BLOCK. Idle lanes of the last block get weight zero.
    """
    tune_loops()
    zero = float32(0.0)
    scale = float32(-1.0) / temperature
    for b in range(BLOCK):
        scratch[_SUM + b] = zero
        scratch[_SQUARES + b] = zero
    for block in range(blocks):
        first = U(block) * BLOCK
        for b in range(BLOCK):
            cost = costs[first + b]
            weight = exp_nonpositive((cost - least) * scale)
            weight = weight if cost < INVALID else zero
            weight = weight if first + b < U(samples) else zero
            weights[first + b] = weight
            scratch[_SUM + b] += weight
            scratch[_SQUARES + b] += weight * weight
    total, squares = row_sum(scratch, _SUM), row_sum(scratch, _SQUARES)
    return total, total * total / squares


@block_function
def temperature_for(
    target: float,
    weights: Floats,
    scratch: Floats,
    costs: Floats,
    blocks: int,
    samples: int,
    least: float,
    guess: float,
) -> tuple[float, float, float]:
    """Temperature at which the effective sample size is `target` within 1 %; leaves the weights at it.

    Safeguarded secant in the logarithms of both, from `guess` (the last step's). Returns temperature, sum, size.
    A target that no temperature between 1e-6 and 1e6 reaches gives the nearest end.
    """
    low, high = math.log(1e-6), math.log(1e6)
    at = min(max(math.log(guess), low), high)
    target_log = math.log(target)
    total, size = weigh(weights, scratch, costs, blocks, samples, least, float32(math.exp(at)))
    last_at, last_miss = at, math.log(size) - target_log
    at += -0.5 if last_miss > 0.0 else 0.5
    for _ in range(40):
        if abs(last_miss) < 0.01:
            break
        if last_miss > 0.0:
            high = min(high, last_at)
        else:
            low = max(low, last_at)
        if high - low < 1e-4:
            break
        if not low < at < high:
            at = 0.5 * (low + high)
        total, size = weigh(weights, scratch, costs, blocks, samples, least, float32(math.exp(at)))
        miss = math.log(size) - target_log
        slope = (miss - last_miss) / (at - last_at)
        last_at, last_miss = at, miss
        at = at - miss / slope if slope > 1e-3 else (low - 1.0)
    return float32(math.exp(last_at)), total, size


@block_function
def mean_over_points(costs: Floats, point_costs: Floats, weights: Floats, blocks: int) -> None:
    """Add the weighted mean over the points, `point_costs` (L, K'), to `costs` (K',)."""
    tune_loops()
    padded = blocks * int(BLOCK)
    for i in range(weights.size):
        weight = weights[i]
        for block in range(blocks):
            to, source = U(block) * BLOCK, U(i * padded) + U(block) * BLOCK
            for b in range(BLOCK):
                costs[to + b] += weight * point_costs[source + b]


@block_function
def worst_over_points(
    costs: Floats, point_costs: Floats, weights: Floats, blocks: int, part: float, order: NDArray[np.int64]
) -> None:
    """Add the mean over the worst `part` of the points' weight (CVaR) to `costs`; weights are not negative.

    `order` (L,) is scratch. A part so small that the worst point fills it gives the worst point's cost.
    """
    padded = blocks * int(BLOCK)
    points = weights.size
    for k in range(padded):
        for i in range(points):
            j = i
            cost = point_costs[i * padded + k]
            while j > 0:
                before = point_costs[order[j - 1] * padded + k]
                # What is no number comes first: a sequence without a cost under some point has none.
                if math.isnan(before) or before >= cost:
                    break
                order[j] = order[j - 1]
                j -= 1
            order[j] = i
        left = part
        total = cast_like(0.0, part)
        for i in range(points):
            used = min(left, weights[order[i]])
            if used > 0.0:
                total += used * point_costs[order[i] * padded + k]
                left -= used
        costs[k] += total / (part - left)
