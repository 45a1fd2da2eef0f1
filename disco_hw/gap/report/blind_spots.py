"""What a log could not have shown: for each effect that was not found, the smallest size that would have been seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Effect, Parameter
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.least_squares import inverse, sensitivity, solve
from disco_hw.gap.search.richest_model import CANDIDATES, LATE_COLUMNS, candidates_of

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BlindSpot:
    """An effect that was not found: the parameter that measures it, its smallest visible size, None if none is.

    For a limit it is the largest that would have been seen. `blind` if realistic sizes would have stayed hidden.
    `proved`: whether a search found it when it was put into this very log; None if that was not tried.
    """

    name: str
    parameter: str
    unit: str
    smallest_visible: float | None
    blind: bool
    experiment: str
    proved: bool | None = None


def blind_spots(found: ChannelResult, top_rad_s: float | None = None) -> tuple[BlindSpot, ...]:
    """Blind spots of one channel, one for each of its effects that was not accepted.

    `top_rad_s`: the largest wheel speed of the robot, if it is known; without it nobody knows what was not asked of it.
    """
    channel = found.selector.channel
    missing = [name for name in candidates_of(channel.layout) if name not in found.names]
    spots = [_limit(found, name, top_rad_s) if REGISTRY[name].is_limit else _spot(found, name) for name in missing]
    for spot in tuple(spots):
        for other, effect in REGISTRY.items():
            if effect.mimics is not None and effect.mimics.effect.name == spot.name:
                parameter = next(p for p in effect.parameters if p.realistic is not None)
                size = spot.smallest_visible
                spots.append(
                    BlindSpot(other, parameter.name, spot.unit, size, is_blind(other, size), experiment_of(other))
                )
    return tuple(spots)


def _spot(found: ChannelResult, name: str) -> BlindSpot:
    parameter = REGISTRY[name].parameters[0]
    size = _size(found, name, f"{name}.{parameter.name}")
    return BlindSpot(name, parameter.name, parameter.unit, size, is_blind(name, size), experiment_of(name))


def is_blind(name: str, size: float | None) -> bool:
    """Whether realistic sizes stay hidden where this is the smallest visible one; of a limit, the largest."""
    effect = REGISTRY[name]
    realistic = _realistic(next((p for p in effect.parameters if p.realistic is not None), effect.parameters[0]))
    if effect.is_limit:
        return size is None or (size < realistic < math.inf)
    return size is None or size > realistic


def _realistic(parameter: Parameter) -> float:
    """A size that real robots show; an effect whose smallest visible size is above it is one this log is blind to."""
    return math.inf if parameter.realistic is None else parameter.realistic


def experiment_of(name: str) -> str:
    """The drive that shows an effect, as it is typed, and what it is."""
    effect = REGISTRY[name]
    return f"disco-hw drive ROBOT.toml --script {effect.script}: {effect.excitation}"


def _limit(found: ChannelResult, name: str, top_rad_s: float | None) -> BlindSpot:
    channel, effect = found.selector.channel.inner, REGISTRY[name]
    parameter, possible = effect.parameters[0], math.inf
    if effect.limited is None or not isinstance(channel, WheelChannel):
        largest = _largest_tried(found, effect)
    else:
        geometry = (float(channel.geometry[0]), float(channel.geometry[1]))
        largest = _largest(channel, effect.limited, geometry)
        if top_rad_s is not None:
            possible = channel.settings.report.asked_share * float(
                effect.limited(np.array([[-top_rad_s, top_rad_s]]), geometry)[0]
            )
    enough = min(possible, _realistic(parameter))
    blind = largest is None or (largest < enough < math.inf)
    return BlindSpot(name, parameter.name, parameter.unit, largest, blind, experiment_of(name))


def _largest(
    wheels: WheelChannel, limited: Callable[[Array, tuple[float, float]], Array], geometry: tuple[float, float]
) -> float | None:
    """The largest limit that cuts at least half a second of the commands."""
    command = wheels.drive.command_rad_s
    size = limited(command[np.isfinite(command[:, 0])], geometry)
    if size.size < 200 or size.max() < 1e-3:
        return None
    return float(0.97 * np.sort(size)[-50])


def _largest_tried(found: ChannelResult, effect: Effect) -> float | None:
    """The largest of a limit's trials that would have shown, with what makes wheels late, as that may hide it."""
    channel, best = found.selector.channel, found.fit
    layout, limits = channel.layout, found.selector.thresholds
    places = tuple(
        layout.place[name] for name in LATE_COLUMNS if name in layout.place and layout.place[name] not in best.active
    )
    slope = np.column_stack([best.jacobian, sensitivity(channel, best.vector, places, best.residual)])
    vector = best.vector.copy()
    for limit in effect.trials:
        vector[layout.place[effect.columns[0]]] = limit
        moved = channel.residual(vector) - best.residual
        own = moved - slope @ solve(slope, slope.T @ moved)
        enough = (limits.score + math.log(max(channel.count, 2))) * channel.settings.report.usual_inflation
        ahead_m = found.selector.moves(channel.split(best.vector), channel.split(vector))
        if float(own @ own) > enough and ahead_m > limits.moves_m:
            return limit
    return None


def _size(found: ChannelResult, name: str, column: str) -> float | None:
    """Size at which the expected evidence reaches the threshold and the 2 s prediction moves as far as it must.

    The other free parameters make up for what they can.
    """
    channel, best = found.selector.channel, found.fit
    layout, candidate, limits = channel.layout, CANDIDATES[name], found.selector.thresholds
    threshold = limits.score + candidate.parameters * math.log(max(channel.count, 2))
    if candidate.profile is not None and column == candidate.profile.column:
        return _by_trial(found, column, REGISTRY[name].trials, threshold)
    vector = best.vector.copy()
    if candidate.profile is not None:
        values = candidate.profile.values(channel)
        if not values:
            return None
        vector[layout.place[candidate.profile.column]] = values[len(values) // 2]
    places = tuple(layout.place[name] for name in candidate.columns)
    base = channel.residual(vector)
    slope = np.column_stack([best.jacobian, sensitivity(channel, vector, places, base)])
    first = best.jacobian.shape[1]
    information = slope.T @ slope
    if information[first, first] <= 1e-9:
        return None
    covariance = inverse(information)
    size = math.sqrt(threshold * channel.settings.report.usual_inflation * float(covariance[first, first]))
    limit = max(abs(layout.low[places[0]]), abs(layout.high[places[0]]))
    if size >= limit:
        return None
    # With the size of one parameter go, of those not said, the values that hide it best.
    with_it = vector.copy()
    with_it[[*best.active, *places]] += size * covariance[first] / covariance[first, first]
    moved = found.selector.moves(channel.split(vector), channel.split(with_it))
    if moved < limits.moves_m:
        size = size * limits.moves_m / moved if moved > 0.0 else math.inf
    return size if size < limit else None


def _by_trial(found: ChannelResult, column: str, trials: tuple[float, ...], threshold: float) -> float | None:
    """Smallest of a row of sizes whose prediction differs from the one without clearly, and enough to matter."""
    channel, best = found.selector.channel, found.fit
    place = channel.layout.place[column]
    for size in trials:
        vector = best.vector.copy()
        vector[place] = size
        difference = channel.residual(vector) - best.residual
        enough = found.selector.moves(channel.split(best.vector), channel.split(vector))
        if (
            float(difference @ difference) > threshold * channel.settings.report.usual_inflation
            and enough > found.selector.thresholds.moves_m
        ):
            return size
    return None
