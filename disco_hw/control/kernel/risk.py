"""From the costs under each parameter point to one cost a sample: their mean, or the mean of the worst part."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel.layout import BLOCK, Floats, U
from disco_hw.jit import block_function, cast_like, tune_loops


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
