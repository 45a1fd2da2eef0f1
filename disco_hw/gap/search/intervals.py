"""95 % intervals and the joint covariance of what was fitted, widened where the noise model is too narrow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Channel
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.search.candidates import CANDIDATES, indices
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.evidence import inflation
from disco_hw.gap.search.least_squares import fit

Array = NDArray[np.float64]

# Of the robot's turning, which act on the wheels: known in wheel speeds, times radius over axial distance.
_OF_TURNING = tuple(
    column
    for effect in REGISTRY.values()
    if effect.uses_geometry and effect.channel is Channel.COMMAND_TO_WHEEL
    for column in effect.columns
)
Z95 = 1.96
_RISE = 0.5 * Z95**2


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """A parameter with its 95 % interval."""

    value: float
    low: float
    high: float

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
    """Intervals of all parameters that a channel's accepted set frees."""
    best, channel = found.fit, found.selector.channel
    columns = channel.layout.columns
    factors = np.array([inflation(best, channel, (index,)) for index in best.active])
    covariance = best.covariance() * np.sqrt(np.outer(factors, factors))
    deviations = np.sqrt(np.diag(covariance))
    by_name = {
        columns[index]: ParameterEstimate(
            float(best.vector[index]), *_around(float(best.vector[index]), float(deviation))
        )
        for index, deviation in zip(best.active, deviations, strict=True)
    }
    for name in found.names:
        profile = CANDIDATES[name].profile
        if profile is not None:
            by_name[profile.column] = _profiled(found, profile.column, profile.refine)
    return ChannelEstimates(by_name, tuple(columns[index] for index in best.active), covariance)


def in_motion(wheels: ChannelEstimates, body: ChannelEstimates) -> ChannelEstimates:
    """The wheels' estimates, where those of the robot's motion are no better known than its geometry in `body`."""
    slope = np.zeros(len(body.fitted))
    for name, sign in (("wheel_radius_m", 1.0), ("axial_distance_m", -1.0)):
        if name in body.fitted:
            slope[body.fitted.index(name)] = sign / body.by_name[name].value
    of_ratio = float(slope @ body.covariance @ slope)
    moved = {name: wheels.by_name[name] for name in _OF_TURNING if name in wheels.by_name}
    added = np.array([moved[name].value if name in moved else 0.0 for name in wheels.fitted])
    by_name = {
        name: ParameterEstimate(
            each.value, *_around(each.value, float(np.hypot(each.deviation, each.value * of_ratio**0.5)))
        )
        for name, each in moved.items()
    }
    covariance = wheels.covariance + of_ratio * np.outer(added, added)
    return ChannelEstimates({**wheels.by_name, **by_name}, wheels.fitted, covariance)


def _around(value: float, deviation: float) -> tuple[float, float]:
    return value - Z95 * deviation, value + Z95 * deviation


def _profiled(found: ChannelResult, column: str, step: float) -> ParameterEstimate:
    """Interval in which the profile of the cost rises by no more than 1.92 nats."""
    selector, best = found.selector, found.fit
    channel = selector.channel
    place = channel.layout.place[column]
    active = indices(channel, found.names)
    edges = []
    for sign in (-1.0, 1.0):
        reach = step
        while True:
            vector = best.vector.copy()
            vector[place] += sign * reach
            if fit(channel, vector, active, 1).cost > best.cost + _RISE or reach > 64.0 * step:
                break
            reach *= 2.0
        edges.append(float(best.vector[place] + sign * reach))
    return ParameterEstimate(float(best.vector[place]), edges[0], edges[1])
