"""The named effects as they compete: what each frees of a channel's parameter vector, and where its fit starts.

An effect of the registry competes with all its parameters, from its own start values. Listed here is only what is
different: parameters in which the residual is not smooth, and effects with the equations of another.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Channel as Place
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.layout import Layout
from disco_hw.gap.noise.channels import BodyChannel, ResidualChannel, WheelChannel

Array = NDArray[np.float64]
Starts = tuple[tuple[float, ...], ...]

# Indistinguishable from another effect, or from two at once: decided after the others, in `classes`.
DECIDED_LATER = ("pose_offset", "encoder_scale")
# What a patch of the floor looks like if it is left and not entered again.
CHANGE = "surface_change"
_RISES_S = (0.15, 0.5, 1.2)


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


def _below_largest(turning: bool) -> Callable[[ResidualChannel], Starts]:
    """Limits start where they cut a part of what was commanded."""

    def starts(channel: ResidualChannel) -> Starts:
        wheels = channel.inner
        assert isinstance(wheels, WheelChannel)
        command = wheels.drive.command_rad_s
        command = command[np.isfinite(command[:, 0])]
        size = np.abs(0.5 * (command[:, 1] - command[:, 0])) if turning else np.abs(command).max(axis=1)
        largest = float(size.max()) if size.size else 0.0
        if turning:
            largest *= 2.0 * wheels.geometry[0] / wheels.geometry[1]
        return tuple((share * largest,) for share in (0.92, 0.75, 0.5)) if largest > 0.1 else ()

    return starts


def _slow_to_turn(channel: ResidualChannel) -> Starts:
    """Limits of the yaw acceleration start where the fastest turn that was commanded takes a while."""
    fastest = _below_largest(True)(channel)
    return tuple((fastest[0][0] / rise_s,) for rise_s in _RISES_S) if fastest else ()


def _stiction_values(channel: ResidualChannel) -> tuple[float, ...]:
    return tuple(np.arange(0.1, 2.05, 0.1).tolist())


def _change_times(channel: ResidualChannel) -> tuple[float, ...]:
    body = channel.inner
    assert isinstance(body, BodyChannel)
    first, last = float(body.samples.t_s[0]), float(body.samples.t_s[-1])
    if last - first < 30.0:
        return ()
    return tuple(np.arange(first + 10.0, last - 10.0, max(4.0, (last - first) / 40.0)).tolist())


_SPECIAL = (
    Candidate("motor_lag", ("motor_lag.tau_s",), lambda channel: ((0.05,), (0.25,))),
    Candidate("command_delay", ("command_delay.delay_s",), lambda channel: ((0.03,), (0.12,), (0.3,))),
    Candidate("deadband", ("deadband.width_rad_s",), lambda channel: ((0.2,),)),
    Candidate("stiction", (), None, Profile("stiction.threshold_rad_s", _stiction_values, 0.002)),
    Candidate("speed_limit", ("speed_limit.limit_rad_s",), _below_largest(False)),
    Candidate("yaw_rate_limit", ("yaw_rate_limit.limit_rad_s",), _below_largest(True)),
    Candidate("yaw_acceleration_limit", ("yaw_acceleration_limit.limit_rad_s2",), _slow_to_turn),
    Candidate(
        "surface_change",
        ("surface_change.track", "surface_change.radius"),
        None,
        Profile("surface_change.time_s", _change_times, 0.25),
    ),
)


def _competing() -> dict[str, Candidate]:
    special = {candidate.name: candidate for candidate in _SPECIAL}
    return {
        name: special.get(name) or Candidate(name, tuple(f"{name}.{p.name}" for p in effect.parameters))
        for name, effect in REGISTRY.items()
        if name not in DECIDED_LATER
    }


CANDIDATES: Mapping[str, Candidate] = MappingProxyType(_competing())


def candidates_of(layout: Layout) -> tuple[str, ...]:
    """Names of the effects that compete in the channel of a layout."""
    return tuple(name for name in CANDIDATES if (REGISTRY[name].channel is Place.COMMAND_TO_WHEEL) == layout.of_wheels)


def parameters_of(names: tuple[str, ...]) -> int:
    """Number of parameters of a set of effects."""
    return sum(CANDIDATES[name].parameters for name in names)


def indices(channel: ResidualChannel, names: tuple[str, ...]) -> tuple[int, ...]:
    """Places in the parameter vector of what a set of effects frees, after those that are always free."""
    place = channel.layout.place
    return (*channel.free, *(place[column] for name in names for column in CANDIDATES[name].columns))
