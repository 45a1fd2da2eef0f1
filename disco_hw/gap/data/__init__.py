"""Data of the search: a drive on an even grid, parameter vectors, free runs of the model.

This module has the parameter vector of each channel: every parameter of every effect in the registry, by full name. At
its neutral value an effect changes nothing, so one vector and one compiled free run serve every set of effects.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects import Channel, Effect, Parameter, Stage, arguments_of
from disco_hw.effects.registry import DELAY, MOTION_EFFECTS, REGISTRY, in_stages
from disco_hw.gap.settings import GRID_STEP_S
from disco_hw.model.coefficients import Base, Coefficients, Effects
from disco_hw.model.model import BASE_PARAMETERS

Array = NDArray[np.float64]

BASE_COUNT = len(BASE_PARAMETERS)

# Difference steps by unit: well above rounding, well below what a log resolves.
_STEPS: Mapping[str, float] = {
    "s": 2e-3,
    "rad/s": 2e-2,
    "rad/s^2": 1e-2,
    "m": 1e-4,
    "m/s": 1e-4,
    "m/rad": 1e-3,
    "rad": 1e-3,
    "1": 2e-4,
}
_OTHER_STEP = 1e-3
_UNLIMITED = 1e6


@dataclass(frozen=True)
class Layout:
    """Columns of a channel's vector, its neutral point, how each varies; `of_wheels`: which of the two channels.

    `precision`: how surely an entry is near its neutral value before a log is looked at, mostly 0. `spans`: where the
    parameters of each effect are, which follow each other.
    """

    of_wheels: bool
    columns: tuple[str, ...]
    neutral: Array
    step: Array
    low: Array
    high: Array
    precision: Array
    place: Mapping[str, int]
    spans: Mapping[str, slice]

    def at(self, p: Array, name: str) -> float:
        """One entry of a vector."""
        return float(p[self.place[name]])


def _layout(parameters: Mapping[str, Parameter], base: int) -> Layout:
    columns = tuple(parameters)
    place = {name: k for k, name in enumerate(columns)}
    spans = {
        name: slice(place[effect.columns[0]], place[effect.columns[0]] + len(effect.columns))
        for name, effect in REGISTRY.items()
        if effect.columns[0] in place
    }
    neutral = np.array([min(p.neutral, _UNLIMITED) for p in parameters.values()])
    low = np.array([p.low if p.least_fitted is None else p.least_fitted for p in parameters.values()])
    return Layout(
        of_wheels=base == 0,
        columns=columns,
        neutral=neutral,
        step=np.array(
            [1e-4 if k < base else _STEPS.get(p.unit, _OTHER_STEP) for k, p in enumerate(parameters.values())]
        ),
        low=low,
        high=np.array([max(p.high, p.neutral if p.neutral < np.inf else _UNLIMITED) for p in parameters.values()]),
        precision=np.array([p.expected**-2.0 for p in parameters.values()]),
        place=MappingProxyType(place),
        spans=MappingProxyType(spans),
    )


def _of_channels(*channels: Channel) -> dict[str, Parameter]:
    return {
        f"{name}.{parameter.name}": parameter
        for name, effect in REGISTRY.items()
        if effect.channel in channels or effect.stage is Stage.ENCODERS
        for parameter in effect.parameters
    }


WHEEL = _layout(_of_channels(Channel.COMMAND_TO_WHEEL), 0)
BODY = _layout(
    {p.name: p for p in BASE_PARAMETERS} | _of_channels(Channel.WHEEL_TO_BODY, Channel.POSE_SENSOR), BASE_COUNT
)


def _coefficients(layout: Layout, p: Array, name: str, base: tuple[float, ...]) -> tuple[float, ...]:
    return _kept(name, tuple(p[layout.spans[name]].tolist()), base)


# From one free run to the next most effects stay as they are.
@lru_cache(maxsize=512)
def _kept(name: str, values: tuple[float, ...], base: tuple[float, ...]) -> tuple[float, ...]:
    columns = REGISTRY[name].coefficients(np.array([values]), np.array([base]), GRID_STEP_S)
    return tuple(float(column[0]) for column in columns)


# The delay is the free run's own affair, what acts in the world that of who lays its path on poses.
_IN_STEP = [name for name in MOTION_EFFECTS if REGISTRY[name].stage not in (Stage.DELAY, Stage.WORLD)]
WHEEL_MOTION = tuple(name for name in _IN_STEP if REGISTRY[name].channel is Channel.COMMAND_TO_WHEEL)
BODY_MOTION = tuple(name for name in _IN_STEP if REGISTRY[name].channel is Channel.WHEEL_TO_BODY)
# What holds the response of one wheel to that of the other takes most of the time of a run, also where it is no limit.
_HOLDING = tuple(name for name in WHEEL_MOTION if REGISTRY[name].stage is Stage.RESPONSE and REGISTRY[name].is_limit)
DELAYED_BY = DELAY.columns[0]
# What the encoders count wrong, in either channel's vector.
_ENCODERS = in_stages(Stage.ENCODERS)
ENCODER_COLUMNS = tuple(column for effect in _ENCODERS for column in effect.columns)
_POSE_TIME, _POSE, _WORLD = in_stages(Stage.POSE_TIME), in_stages(Stage.POSE), in_stages(Stage.WORLD)
_ARGUMENTS = {effect.name: arguments_of(effect.plain) for effect in (*_ENCODERS, *_POSE_TIME, *_POSE, *_WORLD)}
_SENSED = np.array(
    [*range(BASE_COUNT), *(BODY.place[column] for effect in (*_POSE_TIME, *_POSE) for column in effect.columns)]
)


class PoseSensor(NamedTuple):
    """Pose sensor that a parameter vector of the body channel describes.

    Delay of the poses (s), position ahead and left of the tracked point (m), error of the yaw (rad).
    """

    delay_s: float
    forward_m: float
    left_m: float
    bias_rad: float


def pose_sensor(p: Array) -> PoseSensor:
    """Return the pose sensor of a parameter vector whose entries are in the order of `BODY.columns`."""
    return _sensor(tuple(p[_SENSED].tolist()))


@lru_cache(maxsize=512)
def _sensor(values: tuple[float, ...]) -> PoseSensor:
    p = BODY.neutral.copy()
    p[_SENSED] = values
    delay_s = -sum(float(_plain(BODY, p, effect, time_s=0.0)) for effect in _POSE_TIME)
    mount = 0.0, 0.0, 0.0
    for effect in _POSE:
        mount = _plain(BODY, p, effect, x=mount[0], y=mount[1], yaw=mount[2])
    return PoseSensor(delay_s, *(float(each) for each in mount))


def carried(p: Array, speed_rad_s: Array, t_s: Array) -> Array:
    """Return how far the ground has carried a robot by each node (M, 2), m in the world frame.

    `p`: vector of the body channel; `speed_rad_s` (M, 2): measured wheel speeds; `t_s` (M,): times of the nodes.
    """
    moved = np.zeros_like(speed_rad_s)
    places = [(effect, BODY.spans[effect.name]) for effect in _WORLD]
    acting = [effect for effect, place in places if (p[place] != BODY.neutral[place]).any()]
    # Most robots stand on level ground, and it is asked in every run.
    if not acting:
        return moved
    for effect in acting:
        motion = {
            "wheel_sum": speed_rad_s.sum(axis=1),
            "difference": speed_rad_s[:, 1] - speed_rad_s[:, 0],
            "time_s": t_s,
        }
        x, y = _plain(BODY, p, effect, x=moved[:, 0], y=moved[:, 1], **motion)
        moved = np.column_stack([x, y])
    return np.asarray(np.cumsum(moved, axis=0) * GRID_STEP_S)


def counted(layout: Layout, p: Array) -> tuple[float, float]:
    """Return how many turns the left and right encoder count for one turn of their wheel."""
    turns = 1.0, 1.0
    for effect in _ENCODERS:
        turns = _plain(layout, p, effect, left=turns[0], right=turns[1])
    return float(turns[0]), float(turns[1])


def _plain(layout: Layout, p: Array, effect: Effect, **motion: float | Array) -> Any:
    """Evaluate an effect's plain equation for the motion of one second, with the parameters of a vector."""
    known: dict[str, Any] = {"values": tuple(p[layout.spans[effect.name]].tolist()), "step_s": 1.0, **motion}
    known["geometry"] = tuple(p[:BASE_COUNT].tolist())
    return effect.plain(**{name: known[name] for name in _ARGUMENTS[effect.name]})


def wheel_effects(p: Array, geometry: Array) -> Coefficients:
    """Return the coefficients of the model's wheel step at a vector; `geometry` (3,) serves yaw-rate limits."""
    base = tuple(geometry[:BASE_COUNT].tolist())
    absent = [name for name in _HOLDING if (p[WHEEL.spans[name]] == WHEEL.neutral[WHEEL.spans[name]]).all()]
    given = {name: _coefficients(WHEEL, p, name, base) for name in WHEEL_MOTION if name not in absent}
    made: Coefficients = Effects(**{name: given.get(name) for name in MOTION_EFFECTS})
    return made


def body_effects(p: Array) -> tuple[Base, Coefficients]:
    """Return geometry and coefficients of the model's body velocity at a vector of the body channel."""
    base = tuple(p[:BASE_COUNT].tolist())
    given = {name: _coefficients(BODY, p, name, base) for name in BODY_MOTION}
    radius, axial, x_icr = base
    return (
        Base(0.5 * radius, 0.5 * radius / axial, x_icr),
        Effects(**{name: given.get(name) for name in MOTION_EFFECTS}),
    )
