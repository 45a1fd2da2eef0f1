"""Follow way-points by arc length at a constant speed: round and round if the last is the first, else to the end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Self

import msgspec
from msgspec import Meta

from disco_hw.errors import FieldFault, InputError
from disco_hw.tasks import Chassis, Editable, Point, Positive, straight_fastest_m_s
from disco_hw.tasks.line import check_size, load_waypoints, planned_table, points_of
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.line.course import (
    LineCourse,
    PathProgress,
    line_course,
    refuse_hairpins,
    speed_range,
    straight_too_fast,
)


class PathTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Follow way-points by arc length at a constant speed; round and round if the last is the first, else to the end.

    `path`: CSV with columns x_m, y_m (m, world frame), relative to robot.toml. `points` are what is read from it; no
    field of robot.toml.
    """

    implied_by: ClassVar[str | None] = "path"
    read_fields: ClassVar[tuple[str, ...]] = ("points",)

    path: Annotated[str, Meta(min_length=1)]
    speed_m_s: Positive = 0.2
    points: tuple[Point, ...] = ()

    @property
    def reference_speed_m_s(self) -> float:
        """The speed of [task]."""
        return self.speed_m_s

    @property
    def file(self) -> str | None:
        """Path of the CSV file with the way-points."""
        return self.path

    def with_file(self, file: Path, _robot: Chassis, x_icr_m: float | None) -> Self:
        """Return the task with the way-points of a CSV.

        Raises InputError as `load_waypoints`, and for times, for too many way-points, for a path that is too short or
        too long, for a way-point further from the origin than poses go, and for hairpins unless `x_icr_m` is None.
        """
        found = load_waypoints(file)
        if found.times_s is not None:
            raise InputError(
                f"{file}: line 1: column t_s: a path is followed at task.speed_m_s; remove the column, or follow it "
                'by time with kind = "timed_path" in [task]'
            )
        check_size(file, found)
        if x_icr_m is not None:
            refuse_hairpins(file, found, x_icr_m)
        return msgspec.structs.replace(self, points=points_of(found))

    def fault(self) -> FieldFault | None:
        """Return None: only the way-points' file can be wrong."""
        return None

    def fastest_m_s(self, robot: Chassis) -> float:
        """Speed straight ahead at which the wheels are at their limit."""
        return straight_fastest_m_s(robot)

    def beyond_robot(self, robot: Chassis) -> FieldFault | None:
        """Return the fault of a speed that the wheels cannot do; None if they can."""
        return straight_too_fast(self.speed_m_s, robot)

    def editable(self, robot: Chassis) -> Mapping[str, Editable]:
        """Return the range of the speed, the only field to edit."""
        return speed_range(robot)

    def editing_note(self, robot: Chassis) -> str:
        """Return a sentence with the largest speed straight ahead of the robot's wheels, whatever the path."""
        return f"At most {self.fastest_m_s(robot):.3f} m/s."

    def describe(self) -> str:
        """File, length and speed."""
        return f"path {self.path} of {self.course().length_m:.2f} m at {self.speed_m_s:g} m/s"

    def course(self) -> LineCourse:
        """Return the `LineCourse` through the way-points."""
        return line_course(self.points, "path")

    def progress(self) -> PathProgress:
        """Laps of a closed path, or the part of an open one that is behind."""
        return PathProgress(planned_table(self.points, "default"))

    def planned(self, mode: str) -> PathCost:
        """Return the cost of following the path, for the planner; its line is finer in the default mode."""
        return PathCost(planned_table(self.points, mode), self.speed_m_s)


TASK = PathTask
