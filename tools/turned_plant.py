"""A robot that calls its back its front: the same machine under a controller that drives it the other way round.

Left is right, ahead is behind, and the centre of rotation lies on the other side of the tracked point. Which end of a
skid-steer robot is called its front is up to its owner, and following a line is easier for a tracked point that lies
ahead of the centre of rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import msgspec

from drivers.types import PoseSample, Readings, WheelSample
from tools.foreign_plant import ForeignRobot
from tools.tracking import Plant

Pose = tuple[float, float, float]


def turned_robot(robot: ForeignRobot) -> ForeignRobot:
    """The robot as its controllers know it, by its other front."""
    radius_m, axle_m, x_icr_m = robot.believed
    return replace(robot, x_icr_m=-robot.x_icr_m, believed=(radius_m, axle_m, -x_icr_m))


class TurnedPlant:
    """Drives the plant that `plant_of` makes of the robot as it was before `turned_robot`."""

    def __init__(
        self, plant_of: Callable[[ForeignRobot, Pose, int], Plant], robot: ForeignRobot, start: Pose, seed: int
    ) -> None:
        self._plant = plant_of(turned_robot(robot), _turned(start), seed)

    @property
    def now_ms(self) -> int:
        """Time of the plant, ms."""
        return self._plant.now_ms

    @property
    def now_ns(self) -> int:
        """Time of the plant, ns."""
        return self._plant.now_ns

    @property
    def pose(self) -> Pose:
        """True pose of the tracked point, with the heading of the other front."""
        return _turned(self._plant.pose)

    @property
    def forward_m_s(self) -> float:
        """True speed towards the other front."""
        return -self._plant.forward_m_s

    def readings(self) -> Readings:
        """Return the sensors' samples at this time."""
        found = self._plant.readings()
        return Readings(
            wheels=tuple(_wheels(sample) for sample in found.wheels), poses=tuple(_pose(one) for one in found.poses)
        )

    def advance(self, left_rad_s: float, right_rad_s: float, count: int, /) -> None:
        """Hold these wheel commands for `count` milliseconds."""
        self._plant.advance(-right_rad_s, -left_rad_s, count)


def _turned(pose: Pose) -> Pose:
    x_m, y_m, yaw_rad = pose
    return x_m, y_m, yaw_rad + math.pi


def _pose(sample: PoseSample) -> PoseSample:
    return msgspec.structs.replace(sample, yaw_rad=math.remainder(sample.yaw_rad + math.pi, math.tau))


def _wheels(sample: WheelSample) -> WheelSample:
    return msgspec.structs.replace(
        sample,
        left_angle_rad=-sample.right_angle_rad,
        right_angle_rad=-sample.left_angle_rad,
        left_speed_rad_s=-sample.right_speed_rad_s,
        right_speed_rad_s=-sample.left_speed_rad_s,
    )
