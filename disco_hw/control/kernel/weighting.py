"""From costs to weights: risk over parameter points, then softmax with a given or adapted temperature.

Sums run over lanes in a fixed order, so that the same costs give the same weights bit for bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel.layout import BLOCK, Floats, U
from disco_hw.control.kernel.sequences import row_sum
from disco_hw.jit import block_function, cast_like, float32, float_from_bits, int32, scalar_function, tune_loops
from disco_hw.tasks.cost import single

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
    whole = int32(value * _LOG2_E - float32(0.5))
    rest = value - float32(whole) * _LN2_HIGH - float32(whole) * _LN2_LOW
    series = float32(1.0) + rest * (
        float32(1.0)
        + rest
        * (
            float32(1 / 2)
            + rest * (float32(1 / 6) + rest * (float32(1 / 24) + rest * (float32(1 / 120) + rest * float32(1 / 720))))
        )
    )
    return series * float_from_bits(int32(int32(whole + int32(127)) << int32(23)))


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
    weights: Floats,
    scratch: Floats,
    costs: Floats,
    blocks: int,
    samples: int,
    least: float,
    temperature: float,
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
    wanted = math.log(target)
    total, size = weigh(weights, scratch, costs, blocks, samples, least, float32(math.exp(at)))
    last_at, last_miss = at, math.log(size) - wanted
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
        miss = math.log(size) - wanted
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
            taken = min(left, weights[order[i]])
            if taken > 0.0:
                total += taken * point_costs[order[i] * padded + k]
                left -= taken
        costs[k] += total / (part - left)
