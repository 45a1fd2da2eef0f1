"""The named effects as they compete: what each frees of a channel's parameter vector, and where its fit starts.

An effect of the registry competes with all its parameters, from its own start values, or along its scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Channel as Place
from disco_hw.effects.effect import CommandedDrive, Effect, Stage
from disco_hw.effects.registry import REGISTRY, in_stages
from disco_hw.gap.data.layout import Layout
from disco_hw.gap.noise.channels import BodyChannel, ResidualChannel

Array = NDArray[np.float64]
Starts = tuple[tuple[float, ...], ...]

# What makes wheels late, from the wheel back to the command.
_LATE = [effect for effect in reversed(in_stages(Stage.DELAY, Stage.COMMAND, Stage.RESPONSE)) if effect.late_by]
LATE = tuple(effect.name for effect in _LATE)
LATE_COLUMNS = tuple(f"{effect.name}.{effect.late_by}" for effect in _LATE)
LATE_STARTS_S = tuple(zip(*(effect.late_starts for effect in _LATE), strict=False))


@dataclass(frozen=True, slots=True)
class Profile:
    """An entry that is searched over values: its name, the values for a channel, and how close to search."""

    column: str
    values: Callable[[ResidualChannel], tuple[float, ...]]
    refine: float


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect in the competition.

    `columns` are fitted from each of the `starts`, none of which means from neutral, where the effect is smooth.
    """

    name: str
    columns: tuple[str, ...]
    starts: Callable[[ResidualChannel], Starts] | None = None
    profile: Profile | None = None

    @property
    def parameters(self) -> int:
        """Number of parameters that its evidence must pay for."""
        return len(self.columns) + (self.profile is not None)


def driven(channel: ResidualChannel) -> CommandedDrive:
    """The drive of a channel as effects see it."""
    inner = channel.inner
    commands, geometry = inner.drive.command_rad_s, inner.geometry
    t_s = inner.samples.t_s if isinstance(inner, BodyChannel) else inner.drive.t_s
    known = commands[np.isfinite(commands[:, 0])]
    return CommandedDrive(known, (float(geometry[0]), float(geometry[1])), float(t_s[0]), float(t_s[-1]))


# What makes poses older than their stamps.
OLD_POSE_COLUMNS = tuple(f"{effect.name}.{effect.parameters[0].name}" for effect in in_stages(Stage.POSE_TIME))


def with_pose_delay(channel: BodyChannel, vector: Array) -> Array:
    """A parameter vector with the poses' delay as it is at first sight."""
    delayed = vector.copy()
    places = [channel.layout.place[column] for column in OLD_POSE_COLUMNS]
    delayed[places] = np.clip(channel.drive.pose_delay_s, channel.layout.low[places], channel.layout.high[places])
    return delayed


def _pose_starts(channel: ResidualChannel) -> Starts:
    """Where the fit of a pose's age begins: without any, and at first sight."""
    inner = channel.inner
    assert isinstance(inner, BodyChannel)
    neutral = inner.layout.neutral
    seen = with_pose_delay(inner, neutral)
    return tuple((float(vector[inner.layout.place[OLD_POSE_COLUMNS[0]]]),) for vector in (neutral, seen))


def _candidate(effect: Effect) -> Candidate:
    scan, begin = effect.scan, effect.starts
    fitted = [p.name for p in effect.parameters if scan is None or p.name != scan.parameter]
    if effect.stage is Stage.POSE_TIME:
        return Candidate(effect.name, tuple(f"{effect.name}.{key}" for key in fitted), _pose_starts)
    return Candidate(
        effect.name,
        tuple(f"{effect.name}.{key}" for key in fitted),
        None if begin is None else lambda channel: begin(driven(channel)),
        None
        if scan is None
        else Profile(f"{effect.name}.{scan.parameter}", lambda channel: scan.values(driven(channel)), scan.refine),
    )


def _competing() -> dict[str, Candidate]:
    # What mimics another effect is decided after the others, in `confounding`.
    return {name: _candidate(effect) for name, effect in REGISTRY.items() if effect.mimics is None}


CANDIDATES: Mapping[str, Candidate] = MappingProxyType(_competing())


def candidates_of(layout: Layout) -> tuple[str, ...]:
    """Names of the effects that compete in the channel of a layout."""
    return tuple(name for name in CANDIDATES if (REGISTRY[name].channel is Place.COMMAND_TO_WHEEL) == layout.of_wheels)


def smooth_of(layout: Layout) -> tuple[str, ...]:
    """Those of them that a fit finds from neutral, in the order in which they act."""
    acting = [effect.name for effect in in_stages(*Stage) if effect.smooth]
    return tuple(name for name in acting if name in candidates_of(layout))


def parameters_of(names: tuple[str, ...]) -> int:
    """Number of parameters of a set of effects."""
    return sum(CANDIDATES[name].parameters for name in names)


def indices(channel: ResidualChannel, names: tuple[str, ...]) -> tuple[int, ...]:
    """Places in the parameter vector of what a set of effects frees, after those that are always free."""
    place = channel.layout.place
    return (*channel.free, *(place[column] for name in names for column in CANDIDATES[name].columns))
