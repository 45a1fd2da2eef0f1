"""Follow a figure of eight that crosses itself: the lemniscate of Bernoulli, round and round at a constant speed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Self

import msgspec
import numpy as np
from msgspec import Meta

from disco_hw.errors import FieldFault
from disco_hw.tasks import (
    CENTER_M,
    SLOWEST_M_S,
    Chassis,
    Editable,
    Point,
    Positive,
    beyond_poses,
    least_size_m,
    straight_fastest_m_s,
    too_fast,
    too_small,
)
from disco_hw.tasks.line import planned_table
from disco_hw.tasks.line.cost import PathCost
from disco_hw.tasks.line.course import LineCourse, PathProgress, line_course

# Chosen: smaller than most robots turn in, up to far larger than a hall.
SIZE_M = (0.3, 50.0)
# Chosen: more follows the curve more closely; each piece of the largest is under a metre.
_POINTS = 400
# Its tightest bend, a third of the size, is at least 0.8 x_icr. Chosen: simulated robots leave the figure at 0.75.
_PER_X_ICR = 2.4
# Chosen: smaller is a robot turning on the spot.
_SMALLEST_M = 0.05


class LemniscateTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Follow a lemniscate of Bernoulli, both lobes in turn, at a constant speed.

    `size_m`: from the crossing to the far end of each lobe, along x. With t from 0 to 2 pi, in units of it,
    x = cos t / (1 + sin^2 t), y = x sin t; the tightest bend is at the far ends, of radius size / 3.
    """

    implied_by: ClassVar[str | None] = None
    read_fields: ClassVar[tuple[str, ...]] = ()
    file: ClassVar[str | None] = None

    center_x_m: float = 0.0
    center_y_m: float = 0.0
    size_m: Annotated[float, Meta(ge=_SMALLEST_M)] = 1.5
    speed_m_s: Positive = 0.2

    @property
    def reference_speed_m_s(self) -> float:
        """The speed of [task]."""
        return self.speed_m_s

    def with_file(self, _file: Path, _robot: Chassis, _x_icr_m: float | None) -> Self:
        """Return the task unchanged, because it has no file."""
        return self

    def fault(self) -> FieldFault | None:
        """Return a fault for a figure that goes where no pose is known, else None."""
        return beyond_poses("figure", "size_m", (self.center_x_m, self.center_y_m), self.size_m)

    def fastest_m_s(self, robot: Chassis) -> float:
        """Speed at which the outer wheel is at its limit in the tightest bend."""
        outer = 1.0 + 0.5 * robot.axial_distance_m / (self.size_m / 3.0)
        return straight_fastest_m_s(robot) / outer

    def beyond_robot(self, robot: Chassis) -> FieldFault | None:
        """Return the fault of a size or speed that the robot cannot follow the figure with, or None."""
        return too_small("size_m", self.size_m, least_size_m(_PER_X_ICR, robot), robot) or too_fast(
            self.speed_m_s,
            self.fastest_m_s(robot),
            robot,
            "the outer wheel",
            where=f" on a figure of {self.size_m:g} m",
            instead=", or a larger size",
        )

    def editable(self, robot: Chassis) -> Mapping[str, Editable]:
        """Return the ranges of all fields; the largest speed is that on the present size."""
        low, high = SIZE_M
        return {
            "size_m": Editable(max(low, least_size_m(_PER_X_ICR, robot)), high, "Size (m)"),
            "speed_m_s": Editable(SLOWEST_M_S, self.fastest_m_s(robot), "Speed (m/s)"),
            "center_x_m": Editable(*CENTER_M, "Centre x (m)"),
            "center_y_m": Editable(*CENTER_M, "Centre y (m)"),
        }

    def editing_note(self, robot: Chassis) -> str:
        """Return a sentence with the largest speed for the present size."""
        return f"At a size of {self.size_m:g} m at most {self.fastest_m_s(robot):.3f} m/s."

    def describe(self) -> str:
        """Size, place and speed."""
        centre = f"({self.center_x_m:g}, {self.center_y_m:g}) m"
        return f"lemniscate of {self.size_m:g} m about {centre} at {self.speed_m_s:g} m/s"

    def points(self) -> tuple[Point, ...]:
        """Return the figure as way-points: from the crossing along the lobe to the right, the last on the first."""
        return _points(self.center_x_m, self.center_y_m, self.size_m)

    def course(self) -> LineCourse:
        """Return the `LineCourse` through the points of the figure."""
        return line_course(self.points(), "lemniscate")

    def progress(self) -> PathProgress:
        """Laps of both lobes."""
        return PathProgress(planned_table(self.points(), "default"))

    def planned(self, mode: str) -> PathCost:
        """Return the cost of following the figure, for the planner; its line is finer in the default mode."""
        return PathCost(planned_table(self.points(), mode), self.speed_m_s)


TASK = LemniscateTask


@lru_cache(maxsize=8)
def _points(center_x_m: float, center_y_m: float, size_m: float) -> tuple[Point, ...]:
    t = np.linspace(-0.5 * math.pi, 1.5 * math.pi, _POINTS + 1)
    x = size_m * np.cos(t) / (1.0 + np.sin(t) ** 2)
    y = x * np.sin(t)
    # Rounding is no reason for an end: the last point is the first.
    x[-1], y[-1] = x[0], y[0]
    return tuple(zip((center_x_m + x).tolist(), (center_y_m + y).tolist(), strict=True))
