"""What parts of a log say of a parameter apart, and how far another drive's value may lie from that of this one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.least_squares import by_block, inverse

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class InParts:
    """A parameter in the parts of a log, in order, with the standard deviation of each, (K,)."""

    values: Array
    deviations: Array

    @property
    def variance_between(self) -> float:
        """Variance of the parameter from part to part beyond that of its estimates (DerSimonian and Laird, 1986)."""
        weight = self.deviations**-2.0
        total = float(weight.sum())
        mean = float(weight @ self.values) / total
        excess = float(weight @ (self.values - mean) ** 2) - (self.values.size - 1)
        return max(excess, 0.0) / (total - float((weight**2).sum()) / total)

    @property
    def variance_to_next(self) -> float:
        """Variance of how far the next log of the same length lies from this one, of what wanders at random.

        The parts of one log are nearer to one another in time than two drives: where q is the variance by which a
        random walk moves over a log, means over its parts vary by q / 6, into however many it is divided, and the means
        of two such logs in a row differ by 2 q / 3.
        """
        return 4.0 * self.variance_between

    def apart(self, one: int, other: int) -> float:
        """How far two parts lie apart, in standard deviations of the difference."""
        return float((self.values[other] - self.values[one]) / np.hypot(self.deviations[one], self.deviations[other]))


def wandered(found: ChannelResult) -> dict[str, float]:
    """Variance of each parameter from this log to the next, by full name.

    What halves surely differ by goes on from drive to drive, as a random walk does. Of what changes more quickly a
    drive shows the mean: what shorter parts differ by counts once, as what may be chance does.
    """
    settings = found.channel.settings.report
    variance: dict[str, float] = {}
    for count in (2, settings.short_parts):
        for name, one in in_equal_parts(found, count).items():
            goes_on = count == 2 and abs(one.apart(0, 1)) > settings.drift_sigmas
            apart = one.variance_to_next if goes_on else one.variance_between
            variance[name] = max(apart, variance.get(name, 0.0))
    return variance


def in_equal_parts(found: ChannelResult, count: int) -> dict[str, InParts]:
    """What each of so many parts of a log, of equal length, says of the parameters."""
    blocks = np.unique(found.selector.channel.block).size
    return in_parts(found, count * np.arange(blocks) // max(blocks, 1))


def in_logs(found: ChannelResult, begins_s: Sequence[float]) -> dict[str, InParts]:
    """What each of several logs that were searched together says, each `begins_s` on the time of the blocks."""
    channel = found.selector.channel
    ends_s = (np.unique(channel.block) + 1) * channel.settings.grid.block_s
    return in_parts(found, np.searchsorted(begins_s, ends_s))


def in_parts(found: ChannelResult, parts: NDArray[np.int64]) -> dict[str, InParts]:
    """What each part of a log says of the parameters, to second order; without those of which one says little.

    `parts` (B,): the part of each block of time of the channel, in order.
    """
    best, channel, layout = found.told, found.selector.channel, found.selector.channel.layout
    labels = np.unique(parts)
    if not best.active or labels.size < 2:
        return {}
    settings = channel.settings
    each = settings.selection.block_lengths[1]
    normal, gradient = by_block(best, channel.block)
    inside = [parts == label for label in labels]
    least = settings.fit.part_known_share / labels.size
    # What a part cannot tell from others it does not know, however much depends on it: a circle has one axial distance
    # for every pair of wheels.
    whole = 1.0 / np.diag(inverse(normal.sum(axis=0)))
    enough = np.all([1.0 / np.diag(inverse(normal[of].sum(axis=0))) > least * whole for of in inside], axis=0)
    places = np.array(best.active)[enough]
    if not places.size:
        return {}
    values, deviations = [], []
    for of in inside:
        # Neighbouring blocks err together: a few are taken as one.
        group = np.arange(np.count_nonzero(of)) // each
        blocks = normal[of][:, enough][:, :, enough]
        pulls = gradient[of][:, enough]
        covariance = inverse(blocks.sum(axis=0))
        step = -covariance @ pulls.sum(axis=0)
        # How much more than the noise model says the blocks of a part scatter about what it says itself.
        left = np.zeros((group[-1] + 1, places.size))
        np.add.at(left, group, (pulls + blocks @ step) @ covariance)
        variance = np.maximum(np.diag(covariance), (left**2).sum(axis=0))
        deviations.append(np.sqrt(variance))
        values.append(np.clip(best.vector[places] + step, layout.low[places], layout.high[places]))
    columns = layout.columns
    return {
        columns[index]: InParts(np.array([of[k] for of in values]), np.array([of[k] for of in deviations]))
        for k, index in enumerate(places)
    }
