"""Poses that the motor controller sends with its telemetry, from a sensor that hangs on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drivers.types import PoseSample

SOURCE = "robot"


class RobotPoses:
    """Pose source of the poses that the motor driver received (a `drivers.types.PoseSource`)."""

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the robot's poses."""
        return from_robot

    def close(self) -> None:
        """Do nothing, because the source holds no resources."""


def create_pose_source(**_of_other_sources: Any) -> RobotPoses:
    """Create the robot's pose source; it has no fields of its own in [pose]."""
    return RobotPoses()
