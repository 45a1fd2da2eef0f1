"""Follow way-points by time: be at each place when its time has come."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple, Self

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from disco_hw.errors import FieldFault, InputError
from disco_hw.tasks import Array, Chassis, Editable, Found, Point, Prepared, norm, single, straight_fastest_m_s
from disco_hw.tasks.line import Waypoints, check_size, load_waypoints, points_of
from disco_hw.tasks.line.cost import AGAINST_M
from disco_hw.tasks.line.course import (
    END_M,
    LineCourse,
    describe_part,
    line_course,
    stable_yaw,
    straight_too_fast,
)

# A place that moves by less in a step has no direction.
RESTS_M = 1e-6
_ZERO, _AGAINST = single(0.0), single(AGAINST_M)


class TimedPathTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Follow way-points by time: be at each when its time has come, counted from the start of the task, to the last.

    `path`: CSV with columns t_s (s), x_m, y_m (m, world frame), relative to robot.toml. `points` and `times_s` are what
    is read from it; no fields of robot.toml.
    """

    implied_by: ClassVar[str | None] = None
    read_fields: ClassVar[tuple[str, ...]] = ("points", "times_s")
    reference_speed_m_s: ClassVar[float] = math.nan

    path: Annotated[str, Meta(min_length=1)]
    points: tuple[Point, ...] = ()
    times_s: tuple[float, ...] = ()

    @property
    def speed_m_s(self) -> float:
        """The fastest that the times ask for, straight from one way-point to the next; 0 before they are read."""
        ways = zip(self.points, self.points[1:], self.times_s, self.times_s[1:], strict=False)
        return max((math.dist(here, there) / (then - now) for here, there, now, then in ways), default=0.0)

    @property
    def file(self) -> str | None:
        """Path of the CSV file with the timed way-points."""
        return self.path

    def with_file(self, file: Path, robot: Chassis, _x_icr_m: float | None) -> Self:
        """Return the task with the way-points and times of a CSV.

        Raises InputError as `load_waypoints`, and for missing times, for a first time before the start, for too many
        way-points, for a path that is too short or too long, for a way-point further from the origin than poses go, and
        for way-points that are further apart than the robot can drive between their times.
        """
        found = load_waypoints(file)
        times, fastest_m_s = found.times_s, straight_fastest_m_s(robot)
        if times is None:
            raise InputError(
                f"{file}: line 1: column t_s: missing; add the times in s from the start of the task, or follow the "
                'path at task.speed_m_s with kind = "path" in [task]'
            )
        if times[0] < 0.0:
            raise InputError(
                f"{file}: line {found.lines[0]}: t_s: {times[0]:g} is before the start; begin at 0 or later"
            )
        check_size(file, found)
        way_m = np.hypot(*np.diff(found.places_m, axis=0).T)
        too_fast = way_m > fastest_m_s * np.diff(times)
        if too_fast.any():
            at = int(np.argmax(too_fast)) + 1
            soonest_s = math.ceil(1e3 * (times[at - 1] + way_m[at - 1] / fastest_m_s)) / 1e3
            raise InputError(
                f"{file}: line {found.lines[at]}: t_s: {way_m[at - 1]:g} m from line {found.lines[at - 1]} in "
                f"{times[at] - times[at - 1]:g} s, but the wheels reach {fastest_m_s:.3g} m/s at most; write "
                f"{soonest_s:g} or later"
            )
        return msgspec.structs.replace(self, points=points_of(found), times_s=tuple(times.tolist()))

    def fault(self) -> FieldFault | None:
        """Return None: only the way-points' file can be wrong."""
        return None

    def fastest_m_s(self, robot: Chassis) -> float:
        """Speed straight ahead at which the wheels are at their limit."""
        return straight_fastest_m_s(robot)

    def beyond_robot(self, robot: Chassis) -> FieldFault | None:
        """Return the fault of a speed that the wheels cannot do; None if they can."""
        return straight_too_fast(self.speed_m_s, robot)

    def editable(self, _robot: Chassis) -> Mapping[str, Editable]:
        """Return an empty mapping, because no field can be edited."""
        return {}

    def editing_note(self, _robot: Chassis) -> str:
        """Return a sentence on why nothing can be changed."""
        return "The times of the way-points set the speed; change t_s in their CSV and restart the daemon."

    def describe(self) -> str:
        """File, length, time and the largest speed."""
        length_m = self.course().length_m
        return f"path {self.path} of {length_m:.2f} m in {self.times_s[-1]:g} s, at most {self.speed_m_s:.3g} m/s"

    def course(self) -> LineCourse:
        """Return the `LineCourse` through the way-points."""
        return line_course(self.points, "timed path")

    def progress(self) -> TimedProgress:
        """Create the progress, which is the part of the way that is due."""
        return TimedProgress(self.points, self.times_s)

    def planned(self, _mode: str) -> TimedPathCost:
        """Return the cost of following the way-points in time, for the planner; the same in every mode."""
        return TimedPathCost(Waypoints(np.array(self.points), np.array(self.times_s)))


TASK = TimedPathTask


class TimedProgress:
    """Progress along way-points by time: the part of the way that is due, and whether the last way-point is reached."""

    def __init__(self, points: tuple[Point, ...], times_s: tuple[float, ...]) -> None:
        behind_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(np.array(points), axis=0).T))])
        self._times_s, self._parts, self._length_m = np.array(times_s), behind_m / behind_m[-1], float(behind_m[-1])
        self._end_m = points[-1]
        self._begun_ns: int | None = None
        self._elapsed_s, self._off_m = 0.0, math.inf

    @property
    def laps(self) -> float:
        """The part of the way that should be behind, 0 to 1, of the present run or of the last one while paused."""
        return float(np.interp(self._elapsed_s, self._times_s, self._parts))

    @property
    def finished(self) -> bool:
        """Whether the last time is over and the robot is at the last way-point."""
        return self._begun_ns is not None and self._elapsed_s >= self._times_s[-1] and self._off_m <= END_M

    def describe(self) -> tuple[str, str]:
        """Metres that are due, and the part of the whole."""
        return describe_part(self.laps, self._length_m)

    def add(self, now_ns: int, x_m: float, y_m: float, _yaw_rad: float) -> None:
        """Take in the pose of one tick; the first one after a pause is the start, from which the times count."""
        if self._begun_ns is None:
            self._begun_ns = now_ns
        self._elapsed_s = (now_ns - self._begun_ns) * 1e-9
        self._off_m = math.dist((x_m, y_m), self._end_m)

    def pause(self) -> None:
        """Note that the task does not run in this tick."""
        self._begun_ns = None


@dataclass(frozen=True, eq=False)
class TimedPathCost:
    """Follow way-points with times: c is the distance to where the robot should be now, and facing.

    The place moves on by itself, so nothing but following it is cheap. Facing is as of `PathCost`, against the way that
    the place goes, so that it is not followed backwards; while the place rests it is nothing. Before the first time
    the place is the first way-point, after the last the last one.
    """

    waypoints: Waypoints

    def _where(self, time_s: NDArray[np.floating]) -> tuple[Array, Array]:
        times, places = self.waypoints.times_s, self.waypoints.places_m
        assert times is not None
        x, y = (np.interp(time_s, times, column) for column in places.T)
        return np.asarray(x), np.asarray(y)

    def prepare(
        self, time_s: float, x_m: float, y_m: float, yaw_rad: float, memory: float | None, step_s: float, horizon: int,
        x_icr_m: float = 0.0,
    ) -> Prepared:  # fmt: skip
        """Return kernel terms and their origin, where the robot should be now; rollouts have no memory."""
        x, y = self._where(time_s + step_s * np.arange(horizon + 1))
        along_x, along_y = np.diff(x), np.diff(y)
        length = np.hypot(along_x, along_y)
        length[length < RESTS_M] = np.inf
        columns = (x[1:] - x[0], y[1:] - y[0], along_x / length, along_y / length)
        return Prepared(TimedPathTerms(*(column.astype(np.float32) for column in columns)), (float(x[0]), float(y[0])))


class TimedPathTerms(NamedTuple):
    """Desired position at each step's end, `x`, `y` (T,) m, and the direction it moves in, `along_x`, `along_y` (T,).

    The latter are of length one, or zero while the place rests.
    """

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    along_x: NDArray[np.float32]
    along_y: NDArray[np.float32]

    def stage(
        self, memory: float, step: int, x_old: float, y_old: float, x: float, y: float,
        cos_yaw: float, sin_yaw: float, forward: float, found: Found,
    ) -> tuple[float, float]:  # fmt: skip
        """Return the cost of a step, distance to the place due now and facing backwards, and the unchanged memory."""
        against = max(-(cos_yaw * self.along_x[step] + sin_yaw * self.along_y[step]), _ZERO)
        return norm(x - self.x[step], y - self.y[step]) + _AGAINST * against, memory

    def terminal(self, memory: float, x: float, y: float, cos_yaw: float, sin_yaw: float, found: Found) -> float:
        """Return zero, because there is no terminal cost."""
        return _ZERO

    def headings(self, x_icr_m: float, carried_m: complex = 0.0) -> Array | None:
        """Headings (T + 1,), rad, in which a robot stays with the place, at each step's begin and the last one's end.

        `carried_m`: how far the ground carries the moving robot in a step, along x and y. None while the place rests
        throughout. Python only.
        """
        x, y = np.diff(self.x, prepend=np.float32(0.0)), np.diff(self.y, prepend=np.float32(0.0))
        (moves,) = np.nonzero(self.along_x**2 + self.along_y**2)
        if not moves.size:
            return None
        # A place that rests has the direction in which it goes on.
        along = np.arctan2(self.along_y, self.along_x)[moves]
        after = np.minimum(np.searchsorted(moves, np.arange(self.x.size)), moves.size - 1)
        length_m = np.hypot(x, y)
        if carried_m:
            # No more than half of its way, as where the place comes to rest.
            part = np.minimum(0.5 * length_m[moves] / abs(carried_m), 1.0)
            own = length_m[moves] * np.exp(1j * along.astype(np.float64)) - part * carried_m
            along, length_m[moves] = np.angle(own), np.abs(own)
        return stable_yaw(np.unwrap(along.astype(np.float64))[after], length_m, x_icr_m, False)
