"""How much a log speaks for an effect: gain on held-out blocks, penalised evidence, both honest about noise models.

A noise model is never quite true. The scores of blocks of several lengths say how much more the estimate scatters than
the model believes (a sandwich variance); the evidence is divided by that factor before it is judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.noise.channels import ResidualChannel
from disco_hw.gap.search.least_squares import Fit, by_block, inverse, known

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class EffectEvidence:
    """For one set of effects against a smaller one.

    `gain` in nats of the fit; `held_out` in nats on blocks left out, `repeated` the same without the block that says
    most; `inflation` of the variance; `score` = 2 gain / inflation - parameters ln(n), the difference of BIC.
    """

    gain: float
    held_out: float
    repeated: float
    inflation: float
    score: float


def held_out_by_block(found: Fit, channel: ResidualChannel) -> Array:
    """Half squares on each block (B,) with parameters fitted without it, to second order."""
    label = np.unique(channel.block, return_inverse=True)[1]
    cost = np.asarray(0.5 * np.bincount(label, weights=found.residual**2), dtype=np.float64)
    if not found.active:
        return cost
    normal, gradient = by_block(found, channel.block)
    total = normal.sum(axis=0)
    out = cost.copy()
    for b in range(cost.size):
        # A parameter of which only this block knows stays where it is: leaving out cannot judge it.
        information = known(total - normal[b], total, channel.settings.fit)
        step = np.zeros(information.size)
        step[information] = inverse((total - normal[b])[np.ix_(information, information)]) @ gradient[b][information]
        out[b] += gradient[b] @ step + 0.5 * step @ normal[b] @ step
    return out


def inflation(found: Fit, channel: ResidualChannel, added: tuple[int, ...]) -> float:
    """Largest ratio over block lengths of the sandwich variance to the model's, for the added entries; at least 1.

    The information in blocks is weighed against what is known of the channel: `trusted_blocks` of them in which the
    model holds.
    """
    places = [found.active.index(index) for index in added if index in found.active]
    if not places:
        return 1.0
    covariance = found.covariance()
    moved = covariance[:, places]
    weight = np.linalg.inv(covariance[np.ix_(places, places)])
    largest = 1.0
    for length in channel.settings.selection.block_lengths:
        normal, gradient = by_block(found, channel.block, length)
        if gradient.shape[0] < channel.settings.selection.fewest_blocks:
            continue
        scatter = float(np.einsum("bi,ij,bj->", gradient @ moved, weight, gradient @ moved))
        information = np.einsum("bij,ip,pq,jq->b", normal, moved, weight, moved)
        if information.max() <= 0.0:
            continue
        information = information / information.max()
        # Where few blocks hold most information, as few scatter: fitting takes one of them, and the rest says little of
        # the noise.
        blocks = float(information.sum() ** 2 / (information**2).sum())
        known = channel.trusted_blocks / len(places)
        if known + blocks <= 1.0:
            continue
        largest = max(largest, (known + blocks * scatter / len(places)) / (known + blocks - 1.0))
    return largest


def compare(small: Fit, big: Fit, channel: ResidualChannel, parameters: float) -> EffectEvidence:
    """Evidence for `big` against `small`, which lacks `parameters` of its parameters."""
    added = tuple(index for index in big.active if index not in small.active)
    factor = inflation(big, channel, added)
    gain = small.cost - big.cost
    blocks = held_out_by_block(small, channel) - held_out_by_block(big, channel)
    held_out = float(blocks.sum())
    score = 2.0 * gain / factor - parameters * math.log(max(channel.count, 2))
    return EffectEvidence(gain, held_out, held_out - float(blocks.max(initial=0.0)), factor, score)
