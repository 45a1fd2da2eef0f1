"""Result of a channel's search: its fits, parameters with intervals, and the values of parts of a log.

95 % intervals and the joint covariance of what was fitted are widened where the noise model is too narrow, and by how
far another drive's values may lie from those of this one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Stage
from disco_hw.effects.registry import in_stages
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.evidence import Z95, EffectEvidence, inflation, interval_inflation
from disco_hw.gap.search.least_squares import Fit, by_block, fit, inverse, sensitivity, within
from disco_hw.gap.search.richest_model import CANDIDATES, delay_columns, indices
from disco_hw.gap.search.selection import Names, Selector
from disco_hw.gap.search.unnamed_terms import ResidualChannel, Term, WithTerms

Array = NDArray[np.float64]

_RISE = 0.5 * Z95**2


@dataclass(frozen=True)
class UnnamedTerm:
    """An accepted unnamed term: how it is written, with its coefficient, its evidence, and the term itself."""

    form: str
    evidence: EffectEvidence
    term: Term


@dataclass(frozen=True)
class ChannelResult:
    """Result of a channel's search: its selector (noise held, all fits kept), accepted effects and terms.

    `richest` (n,): whitened residuals of the channel's richest model, which had `richest_parameters`. `either`:
    effects that explain what a patch of the floor does as well.
    """

    selector: Selector
    names: Names
    channel: WheelChannel | BodyChannel
    unnamed: tuple[UnnamedTerm, ...] = ()
    plain: Selector | None = None
    richest: Array | None = None
    richest_parameters: int = 0
    either: tuple[str, ...] = ()

    @property
    def fit(self) -> Fit:
        """The fit of the accepted effects and terms."""
        return self.selector.exact(self.names)

    @cached_property
    def evenly(self) -> Fit | None:
        """The accepted set as it fits wheel errors alike at every speed; None for the body, or if nothing is free."""
        best, channel = self.fit, self.channel
        if not isinstance(channel, WheelChannel) or not best.active:
            return None
        terms, vector = tuple(one.term for one in self.unnamed), best.vector
        for _ in range(channel.settings.fit.rounds):
            plainly = channel.evenly(*self.selector.channel.split(vector))
            even: ResidualChannel = WithTerms.of(plainly, terms) if terms else plainly
            other = fit(even, vector, best.active)
            vector = other.vector
        return other

    @cached_property
    def reported(self) -> Fit:
        """The fit that values are told of and predictions made with: where the noise model does not hold, another."""
        return _reported_fit(self)

    @property
    def base(self) -> Fit:
        """The fit without anything that is missing."""
        selector = self.plain or self.selector
        return selector.exact(selector.given)


def _reported_fit(found: ChannelResult) -> Fit:
    """Return the fit whose values are reported: the accepted one or the one with errors alike at every speed.

    The second is taken if blocks of time agree clearly better on it.

    The noise of wheels is taken to grow with their speed, and weighs slow ones most. What the accepted set cannot
    describe does not: then values are as good as least squares of speeds make them, by the scatter between blocks
    (sandwich variance; White, 1982).
    """
    best, other = found.fit, found.evenly
    if other is None:
        return best
    settings = found.channel.settings.selection
    ratio = np.mean(np.log(deviations_of(other, found.channel)) - np.log(deviations_of(best, found.channel)))
    return other if ratio < math.log(settings.clearly_closer) else best


def deviations_of(best: Fit, channel: ResidualChannel) -> Array:
    """Return standard deviations (A,) of the fitted parameters, from the scatter between blocks of time."""
    factors = [inflation(best, channel, (index,)) for index in best.active]
    return np.asarray(np.sqrt(np.maximum(np.diag(best.covariance()) * factors, 1e-300)))


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """A parameter with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, deviation: float) -> ParameterEstimate:
        """Return the estimate of a normally distributed value, with its 95 % interval."""
        return cls(value, value - Z95 * deviation, value + Z95 * deviation)

    @property
    def deviation(self) -> float:
        """Standard deviation that the interval stands for."""
        return max((self.high - self.low) / (2.0 * Z95), 1e-9)


@dataclass(frozen=True)
class ChannelEstimates:
    """Parameters of a channel by full name, and the covariance (A, A) of the fitted ones in order of `fitted`."""

    by_name: dict[str, ParameterEstimate]
    fitted: tuple[str, ...]
    covariance: Array


def estimate_parameters(found: ChannelResult) -> ChannelEstimates:
    """Return intervals of all parameters that a channel frees: where the values of another drive are expected.

    What another drive gives errs as much as what this one gives; of several logs together, as much as each of them.
    """
    best, channel = found.reported, found.selector.channel
    columns, drives = channel.layout.columns, _drives(channel)
    factors = np.array([drives * interval_inflation(best, channel, (index,)) for index in best.active])
    covariance = best.covariance() * np.sqrt(np.outer(factors, factors))
    variances = np.maximum(np.diag(covariance), 1e-300)
    wandering, stamped = drifted(found), _stamped(found)
    apart = _weightings_apart(found) + _hidden_sensor_errors(found)
    more = np.array(
        [
            (wandering.get(columns[index], 0.0) + apart[place] + stamped.get(columns[index], 0.0)) / variances[place]
            for place, index in enumerate(best.active)
        ]
    )
    chosen, layout = list(best.active), channel.layout
    covariance = within(covariance * np.sqrt(np.outer(1.0 + more, 1.0 + more)), layout.low[chosen], layout.high[chosen])
    deviations = np.sqrt(np.diag(covariance))
    by_name = {
        columns[index]: ParameterEstimate.around(float(best.vector[index]), float(deviation))
        for index, deviation in zip(best.active, deviations, strict=True)
    }
    for name in found.names:
        profile = CANDIDATES[name].profile
        if profile is not None:
            by_name[profile.column] = _profiled(found, profile.column, profile.refine)
    return ChannelEstimates(by_name, tuple(columns[index] for index in best.active), covariance)


def _drives(channel: ResidualChannel) -> int:
    """Return the number of drives whose errors lie between a value and that of another drive, in units of its variance.

    The other one is 1; and L logs that are searched together know their mean L times as well as each does.
    """
    return 1 + len(channel.inner.drive.log_begins_s)


def _weightings_apart(found: ChannelResult) -> Array:
    """Variances, (A,), of what the two weightings of the wheels' errors find, beyond what chance does.

    Were the model right, both would find the same, and the difference vary by the difference of their variances
    (Hausman, 1978); as it is not, either finds what its own mixture of slow and fast wheels makes of it. Two values
    that differ by d vary by d^2 / 2.
    """
    best, evenly = found.reported, found.evenly
    if evenly is None:
        return np.zeros(len(best.active))
    chosen = list(best.active)
    by_chance = np.abs(deviations_of(evenly, found.channel) ** 2 - deviations_of(found.fit, found.channel) ** 2)
    return np.asarray(0.5 * np.maximum((evenly.vector - found.fit.vector)[chosen] ** 2 - by_chance, 0.0))


def _hidden_sensor_errors(found: ChannelResult) -> Array:
    """Variances, (A,), that errors of the pose sensor add which were not found, but which the log may hide.

    On a circle a sensor that is mounted turned looks like one that sits elsewhere, and the fit takes it for where the
    robot turns; on a circle the other way round it takes it for the opposite. Each error is a nuisance parameter with
    a normal prior about none, of the size that real robots have, and the variances are those of the marginal. One that
    is the same in every drive as an effect that was found is told with it.
    """
    best, channel = found.reported, found.selector.channel
    layout = channel.layout
    sizes: dict[int, float] = {
        layout.place[column]: parameter.realistic
        for effect in in_stages(Stage.POSE, Stage.POSE_TIME)
        if effect.mimics is None or effect.mimics.effect.name not in found.names
        for column, parameter in zip(effect.columns, effect.parameters, strict=True)
        if parameter.realistic is not None and layout.place.get(column) not in (None, *best.active)
    }
    if not sizes or not best.active:
        return np.zeros(len(best.active))
    slope = sensitivity(channel, best.vector, tuple(sizes), best.residual)
    across, expected = best.jacobian.T @ slope, np.diag([size**-2.0 for size in sizes.values()])
    left = best.information() - across @ inverse(slope.T @ slope + expected) @ across.T
    return np.asarray(np.maximum(np.diag(inverse(left)) - np.diag(best.covariance()), 0.0))


def _stamped(found: ChannelResult) -> dict[str, float]:
    """Variance, s^2, of the delay of a channel from log to log, by what is known of the stamps.

    Of what is stamped by rows of a log, as the wheels are, it is any between two rows: loops that run side by side meet
    in the same way all along a log, and in another one in the next.
    """
    channel = found.selector.channel
    drive = channel.inner.drive
    stamps_s = drive.command_stamps_s if channel.layout.of_wheels else drive.pose_stamps_s
    return dict.fromkeys(delay_columns(channel.layout), stamps_s**2)


def _profiled(found: ChannelResult, column: str, step: float) -> ParameterEstimate:
    """Interval in which the profile of the cost rises by no more than 1.92 nats, or that of how blocks scatter."""
    selector, best = found.selector, found.fit
    channel = selector.channel
    place = channel.layout.place[column]
    active = indices(channel, found.names)
    ends = []
    for sign in (-1.0, 1.0):
        reach = step
        while True:
            vector = best.vector.copy()
            vector[place] += sign * reach
            there = fit(channel, vector, active, 1)
            if there.cost > best.cost + _RISE or reach > 64.0 * step:
                break
            reach *= 2.0
        ends.append(there)
    value, low, high = (float(each.vector[place]) for each in (best, *ends))
    # Between the ends of the interval it is a parameter as any other, where steps smaller than those may do nothing.
    slope = np.column_stack([best.jacobian, (ends[1].residual - ends[0].residual) / (high - low)])
    precision = None if best.precision is None else np.append(best.precision, 0.0)
    free = replace(best, active=(*best.active, place), slope=slope, precision=precision)
    variance = float(free.covariance()[-1, -1] * interval_inflation(free, channel, (place,)))
    deviation = (_drives(channel) * variance) ** 0.5
    normal = ParameterEstimate.around(value, deviation)
    return ParameterEstimate(value, min(low, normal.low), max(high, normal.high))


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
        """Return the difference of two parts, in standard deviations of the difference."""
        return float((self.values[other] - self.values[one]) / np.hypot(self.deviations[one], self.deviations[other]))


def drifted(found: ChannelResult) -> dict[str, float]:
    """Variance of each parameter from this log to the next, by full name.

    What halves surely differ by goes on from drive to drive, as a random walk does. Of what changes more quickly a
    drive shows the mean: what shorter parts differ by counts once, as what may be chance does. What logs that are
    searched together differ by is what the next one may differ by.
    """
    settings = found.channel.settings
    variance: dict[str, float] = {}
    for count in (2, 4):
        for name, one in in_equal_parts(found, count).items():
            goes_on = count == 2 and abs(one.apart(0, 1)) > settings.selection.sure_sigmas
            apart = one.variance_to_next if goes_on else one.variance_between
            variance[name] = max(apart, variance.get(name, 0.0))
    for name, one in in_logs(found).items():
        variance[name] = max(one.variance_between, variance.get(name, 0.0))
    return variance


def in_equal_parts(found: ChannelResult, count: int) -> dict[str, InParts]:
    """Return the parameters from each of `count` parts of a log of equal length."""
    blocks = np.unique(found.selector.channel.block).size
    return in_parts(found, count * np.arange(blocks) // max(blocks, 1))


def in_logs(found: ChannelResult) -> dict[str, InParts]:
    """Return the parameters from each of several logs searched together, without logs that say little of one."""
    channel = found.selector.channel
    ends_s = (np.unique(channel.block) + 1) * channel.settings.grid.block_s
    return in_parts(found, np.searchsorted(channel.inner.drive.log_begins_s, ends_s), some=True)


def in_parts(found: ChannelResult, parts: NDArray[np.int64], some: bool = False) -> dict[str, InParts]:
    """Return the parameters from each part of a log, to second order.

    `parts` (B,): the part of each block of time of the channel, in order. A parameter of which one part says little is
    left out; with `some`, only that part is, if two others are left.
    """
    best, channel, layout = found.reported, found.selector.channel, found.selector.channel.layout
    labels = np.unique(parts)
    settings = channel.settings
    each = settings.selection.block_lengths[1]
    normal, gradient = by_block(best, channel.block)
    inside = [parts == label for label in labels]
    least = settings.fit.part_known_share / labels.size
    # What a part cannot tell from others it does not know, however much depends on it: a circle has one axial distance
    # for every pair of wheels.
    pooled = 1.0 / np.diag(inverse(normal.sum(axis=0)))
    enough = np.array([1.0 / np.diag(inverse(normal[of].sum(axis=0))) > least * pooled for of in inside])
    if not some:
        enough[:] = enough.all(axis=0)
    estimates: dict[int, list[tuple[float, float]]] = {index: [] for index in best.active}
    for of, knows in zip(inside, enough, strict=True):
        places = np.array(best.active)[knows]
        if not places.size:
            continue
        # Neighbouring blocks err together: a few are taken as one.
        group = np.arange(np.count_nonzero(of)) // each
        blocks = normal[of][:, knows][:, :, knows]
        pulls = gradient[of][:, knows]
        covariance = inverse(blocks.sum(axis=0))
        step = -covariance @ pulls.sum(axis=0)
        # How much more than the noise model says the blocks of a part scatter about what it says itself.
        left = np.zeros((group[-1] + 1, places.size))
        np.add.at(left, group, (pulls + blocks @ step) @ covariance)
        variance = np.maximum(np.diag(covariance), (left**2).sum(axis=0))
        values = np.clip(best.vector[places] + step, layout.low[places], layout.high[places])
        for index, value, deviation in zip(places.tolist(), values.tolist(), np.sqrt(variance).tolist(), strict=True):
            estimates[index].append((value, deviation))
    return {layout.columns[index]: InParts(*np.array(of).T) for index, of in estimates.items() if len(of) > 1}
