"""Poses that the motor controller sends with its telemetry, from a sensor that hangs on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drivers.types import PoseSample

SOURCE = "robot"


class RobotPoses:
    """Satisfies `drivers.types.PoseSource`: what the motor driver received."""

    def receive(self, now_ns: int, from_robot: Sequence[PoseSample]) -> Sequence[PoseSample]:
        """Return the robot's poses."""
        return from_robot

    def close(self) -> None:
        """Hold nothing."""


def make_pose_source(**_of_other_sources: Any) -> RobotPoses:
    """Make the source; it has no fields of its own in [pose]."""
    return RobotPoses()
