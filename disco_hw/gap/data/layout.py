"""The parameter vector of each channel: every parameter of every effect in the registry, by full name.

At its neutral value an effect changes nothing, so one vector and one compiled free run serve every set of effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.effect import Channel, Parameter
from disco_hw.effects.registry import MOTION_EFFECTS, REGISTRY
from disco_hw.gap.data.gridded_drive import GRID_STEP_S
from disco_hw.model.parameter import BASE_PARAMETERS
from disco_hw.model.step import Base, Effects

Array = NDArray[np.float64]

BASE_COUNT = len(BASE_PARAMETERS)

# Difference steps by unit: well above rounding, well below what a log resolves.
_STEPS: Mapping[str, float] = {
    "s": 2e-3,
    "rad/s": 2e-2,
    "rad/s^2": 1e-2,
    "m": 1e-4,
    "m/s": 1e-4,
    "rad": 1e-3,
    "1": 2e-4,
}
_OTHER_STEP = 1e-3
# A host that stamps commands or encoders late shows as a negative delay; better told than hidden in noise.
_EARLIEST_DELAY_S = -0.05
_UNLIMITED = 1e6
# A floor changes how much is lost in turning, and rolling hardly: in a log that only turns both do the same.
_EXPECTED = {"surface_change.radius": 0.05}


@dataclass(frozen=True)
class Layout:
    """Columns of a channel's vector, its neutral point, how each varies; `of_wheels` tells the channels apart.

    `precision`: how surely an entry is near its neutral value before a log is looked at, mostly 0.
    """

    of_wheels: bool
    columns: tuple[str, ...]
    neutral: Array
    step: Array
    low: Array
    high: Array
    precision: Array
    place: Mapping[str, int]

    def at(self, p: Array, name: str) -> float:
        """One entry of a vector."""
        return float(p[self.place[name]])


def _layout(parameters: Mapping[str, Parameter], base: int) -> Layout:
    columns = tuple(parameters)
    neutral = np.array([min(p.neutral, _UNLIMITED) for p in parameters.values()])
    low = np.array([p.low for p in parameters.values()])
    low[[name == "command_delay.delay_s" for name in columns]] = _EARLIEST_DELAY_S
    return Layout(
        of_wheels=base == 0,
        columns=columns,
        neutral=neutral,
        step=np.array(
            [1e-4 if k < base else _STEPS.get(p.unit, _OTHER_STEP) for k, p in enumerate(parameters.values())]
        ),
        low=low,
        high=np.array([max(p.high, p.neutral if p.neutral < np.inf else _UNLIMITED) for p in parameters.values()]),
        precision=np.array([_EXPECTED.get(name, np.inf) ** -2.0 for name in columns]),
        place=MappingProxyType({name: k for k, name in enumerate(columns)}),
    )


def _of_channels(*channels: Channel) -> dict[str, Parameter]:
    return {
        f"{name}.{parameter.name}": parameter
        for name, effect in REGISTRY.items()
        if effect.channel in channels or (name == "encoder_scale")
        for parameter in effect.parameters
    }


WHEEL = _layout(_of_channels(Channel.COMMAND_TO_WHEEL), 0)
BODY = _layout(
    {p.name: p for p in BASE_PARAMETERS} | _of_channels(Channel.WHEEL_TO_BODY, Channel.POSE_SENSOR), BASE_COUNT
)


def _spans(layout: Layout) -> Mapping[str, slice]:
    """Where each effect's parameters lie, which follow each other."""
    first: dict[str, int] = {}
    count: dict[str, int] = {}
    for k, column in enumerate(layout.columns):
        name = column.partition(".")[0]
        first.setdefault(name, k)
        count[name] = count.get(name, 0) + 1
    return MappingProxyType({name: slice(first[name], first[name] + count[name]) for name in first})


_SPANS: Mapping[bool, Mapping[str, slice]] = MappingProxyType(
    {layout.of_wheels: _spans(layout) for layout in (WHEEL, BODY)}
)


def _coefficients(layout: Layout, p: Array, name: str, base: tuple[float, ...]) -> tuple[float, ...]:
    return _kept(name, tuple(p[_SPANS[layout.of_wheels][name]].tolist()), base)


# From one free run to the next most effects stay as they are.
@lru_cache(maxsize=512)
def _kept(name: str, values: tuple[float, ...], base: tuple[float, ...]) -> tuple[float, ...]:
    columns = REGISTRY[name].coefficients(np.array([values]), np.array([base]), GRID_STEP_S)
    return tuple(float(column[0]) for column in columns)


# The command delay is the free run's own affair, the slope that of the world frame.
_NOT_IN_STEP = ("command_delay", "slope")
WHEEL_MOTION = tuple(
    name for name in MOTION_EFFECTS if REGISTRY[name].channel is Channel.COMMAND_TO_WHEEL and name not in _NOT_IN_STEP
)
BODY_MOTION = tuple(
    name for name in MOTION_EFFECTS if REGISTRY[name].channel is Channel.WHEEL_TO_BODY and name not in _NOT_IN_STEP
)


def wheel_effects(p: Array, geometry: Array) -> Any:
    """What the model's wheel step needs at a vector of the wheel channel; `geometry` (3,) serves yaw-rate limits."""
    base = tuple(geometry[:BASE_COUNT].tolist())
    given = {name: _coefficients(WHEEL, p, name, base) for name in WHEEL_MOTION}
    return Effects(**{name: given.get(name) for name in MOTION_EFFECTS})


def body_effects(p: Array) -> tuple[Base, Any]:
    """What the model's body velocity needs at a vector of the body channel."""
    base = tuple(p[:BASE_COUNT].tolist())
    given = {name: _coefficients(BODY, p, name, base) for name in BODY_MOTION}
    radius, axial, x_icr = base
    return (
        Base(0.5 * radius, 0.5 * radius / axial, x_icr),
        Effects(**{name: given.get(name) for name in MOTION_EFFECTS}),
    )
