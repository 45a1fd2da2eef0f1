"""Pose sources, one file each, of which robot.toml's `pose.source` names one, and the convention each may speak in.

docs/add-a-pose-source.md says what a source is.
"""

from __future__ import annotations

import inspect
import math
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal

import msgspec

from drivers.pose import robot
from drivers.types import MessageSource, PoseSample, PoseSource

DEFAULT = robot.SOURCE


@cache
def pose_sources() -> Mapping[str, Callable[..., PoseSource]]:
    """Return the pose sources by name: the `create_pose_source` of each module in this folder that has a `SOURCE`.

    It makes a source of the fields of [pose], of which it takes its own and leaves the others.
    """
    modules = (import_module(each.name) for each in pkgutil.iter_modules(__path__, f"{__name__}."))
    return MappingProxyType(
        {module.SOURCE: module.create_pose_source for module in modules if hasattr(module, "SOURCE")}
    )


def find_pose_source(name: str) -> Callable[..., PoseSource]:
    """Return what makes the source of this name. Raises PoseSourceError for a name not known."""
    known = pose_sources()
    if name not in known:
        raise PoseSourceError(f'there is no source "{name}"; write one of {", ".join(known)}')
    return known[name]


OF_THE_HOST = frozenset({"key", "sender_silence_s"})
"""What a source is given beside the fields of [pose]: the key that `key_file` names, and how long a sender is kept."""


def fields_of(name: str) -> frozenset[str]:
    """Return the fields of [pose] that the source of this name takes, and others may not. Raises PoseSourceError."""
    parameters = inspect.signature(find_pose_source(name)).parameters.values()
    return frozenset(each.name for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY) - OF_THE_HOST


def create_pose_source(source: str, **fields: Any) -> PoseSource:
    """Make the source that `pose.source` names of the fields of [pose]; None is a default. Raises PoseSourceError."""
    return find_pose_source(source)(**{name: value for name, value in fields.items() if value is not None})


_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_RADIANS = {"rad": 1.0, "deg": math.pi / 180.0}


class PoseConvention(msgspec.Struct, frozen=True):
    """Convention of a pose source: units; `clockwise` yaw; `mirrored`: its y is to the right of its x.

    `yaw_offset_rad` (counter-clockwise) is added to its yaw: where the sensor looks aside of the robot's forward.
    `origin` is the pose of the sensor's frame in the world (x, y, yaw), `offset` the place of the sensor on the robot,
    ahead of the tracked point and to its left, `latency_s` how old a sample is beyond what the source says.
    """

    position_unit: Literal["m", "cm", "mm"] = "m"
    yaw_unit: Literal["rad", "deg"] = "rad"
    clockwise: bool = False
    mirrored: bool = False
    yaw_offset_rad: float = 0.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    offset: tuple[float, float] = (0.0, 0.0)
    latency_s: float = 0.0

    def to_source_units(self, position_std_m: float, yaw_std_rad: float) -> tuple[float, float]:
        """Return standard deviations in the units of the source, for a source that takes its own from robot.toml."""
        return position_std_m / _METRES[self.position_unit], yaw_std_rad / _RADIANS[self.yaw_unit]

    def converted(self, sample: PoseSample) -> PoseSample:
        """Return the pose of the tracked point in metres and radians, counter-clockwise, yaw in (-pi, pi].

        Without a heading it is not known where the tracked point is: the position stays the sensor's, which the sample
        then says by its lever arm.
        """
        metres, radians = _METRES[self.position_unit], _RADIANS[self.yaw_unit]
        x_m, y_m = metres * sample.x_m, (-metres if self.mirrored else metres) * sample.y_m
        at_x, at_y, turn = self.origin
        x_m, y_m = _turned(x_m, y_m, turn)
        x_m, y_m = at_x + x_m, at_y + y_m
        t_ns, std_m, yaw_std_rad = (
            sample.t_ns - round(1e9 * self.latency_s),
            metres * sample.position_std_m,
            radians * sample.yaw_std_rad,
        )
        if not sample.has_heading:
            return PoseSample(t_ns, sample.received_ns, x_m, y_m, math.nan, std_m, math.nan, *self.offset)
        yaw_rad = (-radians if self.clockwise else radians) * sample.yaw_rad + turn + self.yaw_offset_rad
        if not math.isfinite(yaw_rad):
            return PoseSample(t_ns, sample.received_ns, x_m, y_m, yaw_rad, std_m, yaw_std_rad)
        ahead_x, ahead_y = _turned(*self.offset, yaw_rad)
        return PoseSample(
            t_ns,
            sample.received_ns,
            x_m - ahead_x,
            y_m - ahead_y,
            math.remainder(yaw_rad, 2.0 * math.pi),
            math.hypot(std_m, math.hypot(*self.offset) * yaw_std_rad),
            yaw_std_rad,
        )


def _turned(x: float, y: float, angle_rad: float) -> tuple[float, float]:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return cosine * x - sine * y, sine * x + cosine * y


AS_OURS = PoseConvention()


class ConvertedPoses:
    """A source behind a convention; satisfies `drivers.types.PoseSource`."""

    def __init__(self, source: PoseSource, convention: PoseConvention) -> None:
        self._source = source
        self._convention = convention

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the source's poses in our convention."""
        return [self._convention.converted(sample) for sample in self._source.receive(now_ns, from_robot)]

    def new_messages(self) -> Sequence[str]:
        """Return the messages of the converted source."""
        return self._source.new_messages() if isinstance(self._source, MessageSource) else ()

    def close(self) -> None:
        """Close the converted source; safe to call twice."""
        self._source.close()


def converted(source: PoseSource, convention: PoseConvention) -> PoseSource:
    """Return the source in our convention; itself where nothing is to be changed."""
    return source if convention == AS_OURS else ConvertedPoses(source, convention)


class SeveralPoses:
    """Sources side by side, each in our convention already; satisfies `drivers.types.PoseSource`."""

    def __init__(self, sources: Sequence[PoseSource], labels: Sequence[str]) -> None:
        self._sources = tuple(zip(labels, sources, strict=True))

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the poses of all of them by their stamps, each with the number of its source."""
        found = [
            msgspec.structs.replace(sample, source=number)
            for number, (_, source) in enumerate(self._sources)
            for sample in source.receive(now_ns, from_robot)
        ]
        return sorted(found, key=lambda sample: (sample.t_ns, sample.source))

    def new_messages(self) -> Sequence[str]:
        """Return the messages of all sources, each under its source's name."""
        return [
            f"{label}: {text}"
            for label, source in self._sources
            if isinstance(source, MessageSource)
            for text in source.new_messages()
        ]

    def close(self) -> None:
        """Close all of them."""
        for _, source in self._sources:
            source.close()


class PoseSourceError(ValueError):
    """A source that cannot be had, by its name or its device; the message is one line with the remedy."""


UNKNOWN_VARIANCE_RAD2 = 1e3
"""Senders write a variance this large, or -1, for a coordinate that they do not measure (robot_localization)."""


def is_heading_filled_in(yaw: float, spread: float) -> bool:
    """Return whether somebody has filled in a heading and its spread (standard deviation or variance, any unit).

    Nobody has where one is not a number, where the spread is negative, and where both are exactly zero, as in a message
    that holds a position only.
    """
    return math.isfinite(yaw) and spread >= 0.0 and (yaw != 0.0 or spread != 0.0)


def is_variance_known(variance_rad2: float) -> bool:
    """Return whether the variance of a heading says anything: not negative, a number, and below 1000 rad^2."""
    return 0.0 <= variance_rad2 < UNKNOWN_VARIANCE_RAD2


def is_heading_measured(yaw_rad: float, variance_rad2: float) -> bool:
    """Return whether a heading with this variance is a measurement: filled in, with a variance that is known."""
    return is_heading_filled_in(yaw_rad, variance_rad2) and is_variance_known(variance_rad2)
