"""Evidence for one set of effects against a smaller one.

Evidence is the gain on held-out blocks and the penalised gain on all of them. A noise model is never quite true. The
scores of blocks of several lengths say how much more the estimate scatters than the model believes (a sandwich
variance); the evidence is divided by that factor before it is judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from disco_hw.gap.search.least_squares import Fit, by_block, inverse, known
from disco_hw.gap.search.unnamed_terms import ResidualChannel

Array = NDArray[np.float64]
Z95 = 1.96
"""So many standard deviations of a normal distribution either side hold 95 %."""


@dataclass(frozen=True, slots=True)
class EffectEvidence:
    """Evidence for one set of effects against a smaller one.

    `gain` in nats of the fit; `held_out` in nats on blocks left out. `held_out_without_best` is that without the block
    with the largest gain. `held_out_without_two_best` is what remains without the two largest: the sum of the other
    blocks, or the largest of them if that is more. `inflation` of the variance; `score` = 2 gain / inflation -
    parameters ln(n), the difference of BIC.
    """

    gain: float
    held_out: float
    held_out_without_best: float
    held_out_without_two_best: float
    inflation: float
    score: float

    def score_without_best(self, parameters: float, count: int) -> float:
        """Return the score of the held-out gain without its best block, for so many parameters and residuals."""
        return 2.0 * self.held_out_without_best / self.inflation - parameters * math.log(max(count, 2))

    def holds_without_two_best(self, count: int) -> bool:
        """Whether a gain remains without the best block, and without two pays for a parameter of `count` residuals.

        What only two blocks show may be chance, and says little of another drive.
        """
        return self.held_out_without_best > 0.0 and self.held_out_without_two_best > 0.5 * math.log(max(count, 2))


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
    return _scatter(found, channel, added)[0]


def interval_inflation(found: Fit, channel: ResidualChannel, added: tuple[int, ...]) -> float:
    """Return the inflation of the variance with which 1.96 standard deviations hold 95 %.

    The scatter of blocks is known only as well as there are blocks. So the interval is that of Student's t (Bell and
    McCaffrey, 2002), and wide if a parameter shows at only two or three moments of a log.
    """
    factor, freedom = _scatter(found, channel, added)
    return factor * (float(stdtrit(max(freedom, 1.0), 0.975)) / Z95) ** 2


def _scatter(found: Fit, channel: ResidualChannel, added: tuple[int, ...]) -> tuple[float, float]:
    """Inflation, and the degrees of freedom by which blocks tell it; infinite where they tell nothing."""
    places = [found.active.index(index) for index in added if index in found.active]
    if not places:
        return 1.0, math.inf
    covariance = found.covariance()
    moved = covariance[:, places]
    weight = np.linalg.inv(covariance[np.ix_(places, places)])
    largest, freedom = 1.0, math.inf
    for length in channel.settings.selection.block_lengths:
        normal, gradient = by_block(found, channel.block, length)
        if gradient.shape[0] < channel.settings.selection.fewest_blocks:
            continue
        scatter = float(np.einsum("bi,ij,bj->", gradient @ moved, weight, gradient @ moved))
        information = np.einsum("bij,ip,pq,jq->b", normal, moved, weight, moved)
        if information.max() <= 0.0:
            return 1.0, math.inf
        information = information / information.max()
        # Where few blocks hold most information, as few scatter: fitting takes one of them, and the rest says little of
        # the noise.
        blocks = float(information.sum() ** 2 / (information**2).sum())
        known = channel.trusted_blocks / len(places)
        if known + blocks <= 1.0:
            continue
        factor = (known + blocks * scatter / len(places)) / (known + blocks - 1.0)
        if factor > largest or freedom == math.inf:
            largest, freedom = max(factor, largest), known + blocks - 1.0
    return largest, freedom


def compare(small: Fit, big: Fit, channel: ResidualChannel, parameters: float) -> EffectEvidence:
    """Evidence for `big` against `small`, which lacks `parameters` of its parameters."""
    added = tuple(index for index in big.active if index not in small.active)
    factor = inflation(big, channel, added)
    gain = small.cost - big.cost
    blocks = held_out_by_block(small, channel) - held_out_by_block(big, channel)
    held_out = float(blocks.sum())
    # One that a fit without it explains by nothing at all is so large that in a difference the others would be lost.
    without_best, others = float(_without_most(blocks, 1).sum()), _without_most(blocks, 2)
    without_two_best = max(float(others.sum()), float(others.max(initial=0.0)))
    score = 2.0 * gain / factor - parameters * math.log(max(channel.count, 2))
    return EffectEvidence(gain, held_out, without_best, without_two_best, factor, score)


def _without_most(blocks: Array, many: int) -> Array:
    """Nats of blocks (B,) without those of so many that say most for something; of no others than such."""
    ordered = np.sort(blocks)
    return ordered[: ordered.size - min(many, int(np.count_nonzero(ordered > 0.0)))]
