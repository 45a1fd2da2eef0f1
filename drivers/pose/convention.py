"""In what units and about which axes a pose source speaks, where that is not metres, radians and counter-clockwise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import msgspec

from drivers.types import PoseSample, PoseSource

_METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_RADIANS = {"rad": 1.0, "deg": math.pi / 180.0}


class PoseConvention(msgspec.Struct, frozen=True):
    """What a source sends: units; `clockwise` yaw; `mirrored`: its y is to the right of its x.

    `yaw_offset_rad` (counter-clockwise) is added to its yaw: where the sensor looks aside of the robot's forward.
    """

    position_unit: Literal["m", "cm", "mm"] = "m"
    yaw_unit: Literal["rad", "deg"] = "rad"
    clockwise: bool = False
    mirrored: bool = False
    yaw_offset_rad: float = 0.0

    def converted(self, told: PoseSample) -> PoseSample:
        """The sample in metres and radians, counter-clockwise, yaw in (-pi, pi]."""
        metres, radians = _METRES[self.position_unit], _RADIANS[self.yaw_unit]
        yaw_rad = (-radians if self.clockwise else radians) * told.yaw_rad + self.yaw_offset_rad
        return PoseSample(
            told.t_ns,
            told.received_ns,
            metres * told.x_m,
            (-metres if self.mirrored else metres) * told.y_m,
            math.remainder(yaw_rad, 2.0 * math.pi),
            metres * told.position_std_m,
            radians * told.yaw_std_rad,
        )


AS_OURS = PoseConvention()


class ConvertedPoses:
    """A source behind a convention; satisfies `drivers.types.PoseSource`."""

    def __init__(self, source: PoseSource, convention: PoseConvention) -> None:
        self._source = source
        self._convention = convention

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """The source's poses in our convention."""
        return [self._convention.converted(sample) for sample in self._source.receive(now_ns, from_robot)]

    def close(self) -> None:
        """Close the source."""
        self._source.close()


def converted(source: PoseSource, convention: PoseConvention) -> PoseSource:
    """The source in our convention; itself where nothing is to be changed."""
    return source if convention == AS_OURS else ConvertedPoses(source, convention)
