"""Task of the paper: follow a circle at a constant speed, counter-clockwise (section V-B)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple, Self

import msgspec
import numpy as np

from disco_hw.errors import FieldFault, InputError
from disco_hw.tasks import (
    CENTER_M,
    SLOWEST_M_S,
    Array,
    Chassis,
    Editable,
    Found,
    Point,
    Positive,
    Prepared,
    RobotTask,
    beyond_poses,
    least_size_m,
    norm,
    norm_and_inverse,
    single,
    straight_fastest_m_s,
    too_fast,
    too_small,
)

RADIUS_M = (0.1, 50.0)
"""Least and largest radius that a person may change it to; the least is larger for a robot with a large x_icr."""
# The radius over the distance from the centre below which progress stops growing.
NEAR_CENTRE = 2.0
# The last heading's error counts so many times the distance that it swings the tracked point by.
TURN_WEIGHT = 2.0
# Sine of the largest angle between heading and way: on a smaller circle the tracked point could only be turned about.
MOST_TURNED = 0.95
# The least radius, at which a simulated robot stays within 6 mm. What paths need between turns is a length of way.
_PER_X_ICR = 1.0 / MOST_TURNED
_ZERO, _TWO = single(0.0), single(2.0)


class CircleTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Follow a circle counter-clockwise at a constant speed (paper, section V-B)."""

    implied_by: ClassVar[str | None] = ""
    read_fields: ClassVar[tuple[str, ...]] = ()
    file: ClassVar[str | None] = None

    center_x_m: float = 0.0
    center_y_m: float = 0.0
    radius_m: Positive = 0.75
    speed_m_s: Positive = 0.2

    @property
    def reference_speed_m_s(self) -> float:
        """The speed of [task]."""
        return self.speed_m_s

    def with_file(self, _file: Path, _robot: Chassis, _x_icr_m: float | None) -> Self:
        """Return the task unchanged, because it has no file."""
        return self

    def fault(self) -> FieldFault | None:
        """Return a fault for a circle that goes where no pose is known, else None."""
        return beyond_poses("circle", "radius_m", (self.center_x_m, self.center_y_m), self.radius_m)

    def fastest_m_s(self, robot: Chassis) -> float:
        """Speed at which the outer wheel is at its limit."""
        outer = 1.0 + 0.5 * robot.axial_distance_m / self.radius_m
        return straight_fastest_m_s(robot) / outer

    def beyond_robot(self, robot: Chassis) -> FieldFault | None:
        """Return the fault of a radius or speed that the robot cannot go round with, or None."""
        fault = too_small("radius_m", self.radius_m, least_size_m(_PER_X_ICR, robot), robot)
        return fault or too_fast(
            self.speed_m_s,
            self.fastest_m_s(robot),
            robot,
            "the outer wheel",
            where=f" on a radius of {self.radius_m:g} m",
            instead=", or a larger radius",
        )

    def editable(self, robot: Chassis) -> Mapping[str, Editable]:
        """Return the ranges of all fields; the largest speed is that on the present radius."""
        low, high = RADIUS_M
        return {
            "radius_m": Editable(max(low, least_size_m(_PER_X_ICR, robot)), high, "Radius (m)"),
            "speed_m_s": Editable(SLOWEST_M_S, self.fastest_m_s(robot), "Speed (m/s)"),
            "center_x_m": Editable(*CENTER_M, "Centre x (m)"),
            "center_y_m": Editable(*CENTER_M, "Centre y (m)"),
        }

    def editing_note(self, robot: Chassis) -> str:
        """Return the range of the radius and the largest speed."""
        low, high, _ = self.editable(robot)["radius_m"]
        return f"Radius {low:g} to {high:g} m; at {self.radius_m:g} m at most {self.fastest_m_s(robot):.3f} m/s."

    def describe(self) -> str:
        """Size, place and speed."""
        centre = f"({self.center_x_m:g}, {self.center_y_m:g}) m"
        return f"circle of {self.radius_m:g} m about {centre} at {self.speed_m_s:g} m/s"

    def course(self) -> CircleCourse:
        """Return the circle as a `CircleCourse`."""
        return CircleCourse(self.center_x_m, self.center_y_m, self.radius_m)

    def progress(self) -> LapCounter:
        """Laps round the centre."""
        return LapCounter(self.center_x_m, self.center_y_m)

    def planned(self, mode: str) -> CircleCost:
        """Return the cost of following the circle, for the planner, in this control mode."""
        cost = CircleCost(self.center_x_m, self.center_y_m, self.radius_m, self.speed_m_s)
        return cost.paper() if mode == "paper" else cost


TASK = CircleTask


def circle_task(task: RobotTask, purpose: str) -> CircleTask:
    """Return the task, which `purpose` needs to be a circle; raises InputError for another."""
    if not isinstance(task, CircleTask):
        raise InputError(f'{purpose} needs a circle: write kind = "circle" with radius_m and speed_m_s in [task]')
    return task


@dataclass(frozen=True, slots=True)
class CircleCourse:
    """A circle, driven counter-clockwise."""

    center_x_m: float
    center_y_m: float
    radius_m: float

    @property
    def noun(self) -> str:
        """Name of the course, "circle"."""
        return "circle"

    @property
    def middle_m(self) -> Point:
        """Centre of the circle: x, y (m)."""
        return self.center_x_m, self.center_y_m

    @property
    def reach_m(self) -> float:
        """Radius of the circle, m."""
        return self.radius_m

    @property
    def length_m(self) -> float:
        """Circumference of the circle, m."""
        return 2.0 * math.pi * self.radius_m

    @property
    def start(self) -> tuple[float, float, float]:
        """East of the centre, facing north."""
        return self.center_x_m + self.radius_m, self.center_y_m, 0.5 * math.pi

    def outline_m(self) -> Array:
        """Points (181, 2), the last on the first."""
        angle = np.linspace(0.0, 2.0 * np.pi, 181)
        x, y = np.cos(angle), np.sin(angle)
        return np.stack((self.center_x_m + self.radius_m * x, self.center_y_m + self.radius_m * y), axis=1)

    def off_m(self, places_m: Array) -> Array:
        """Distance (N,) of positions (N, 2), positive outside."""
        return np.asarray(np.hypot(places_m[:, 0] - self.center_x_m, places_m[:, 1] - self.center_y_m) - self.radius_m)


class LapCounter:
    """Laps round a centre since the task last started, counter-clockwise positive."""

    def __init__(self, center_x_m: float, center_y_m: float) -> None:
        self._center_x_m, self._center_y_m = center_x_m, center_y_m
        self._last_rad: float | None = None
        self._turned_rad = 0.0
        self._paused = True

    @property
    def laps(self) -> float:
        """Laps of the present run, or of the last one while paused."""
        return self._turned_rad / (2.0 * math.pi)

    @property
    def finished(self) -> bool:
        """Always False, because a circle has no end."""
        return False

    def describe(self) -> tuple[str, str]:
        """Return the word "laps" and their number as text."""
        return "laps", f"{self.laps:.2f}"

    def add(self, _now_ns: int, x_m: float, y_m: float, _yaw_rad: float) -> None:
        """Take in the pose of one tick; the first one after a pause starts a new count."""
        angle = math.atan2(y_m - self._center_y_m, x_m - self._center_x_m)
        if self._paused or self._last_rad is None:
            self._turned_rad, self._paused = 0.0, False
        else:
            self._turned_rad += math.remainder(angle - self._last_rad, 2.0 * math.pi)
        self._last_rad = angle

    def pause(self) -> None:
        """Note that the task does not run in this tick."""
        self._paused = True


@dataclass(frozen=True, slots=True)
class CircleCost:
    """Follow a circle counter-clockwise: sum of c = sqrt(d^2 + (s - s0)^2) over the steps, plus lost progress.

    d is the distance to the circle's edge, s the longitudinal speed: the paper's cost (section V-B). It alone is 0.2
    for standing still and less for spinning about an offset centre of rotation. Progress takes the reward from both: it
    is R times the angle by which the tracked point moves on about the centre, zero in sum for any loop beside it; what
    the steps together miss of `progress_part` of s0 costs `progress_weight` times as much as the same miss of speed. A
    robot that drives round pays nothing. The last d counts as much as it would over `terminal_m` more of the way: the
    way back to the edge begins with a loss, as turning in pushes the tracked point out, and would else not pay within
    the horizon. With it counts the last heading, as x_icr times the sine of its error from the one in which the robot
    goes round: the tracked point could else be swung to the edge at the end, and who is beside the edge would stay.
    Facing against the way costs as much as being `against_m` off it. `paper` has none of these.
    """

    center_x_m: float = 0.0
    center_y_m: float = 0.0
    radius_m: float = 0.75
    speed_m_s: float = 0.2
    progress_weight: float = 1.0
    progress_part: float = 0.8
    terminal_m: float = 0.2
    against_m: float = 0.6

    def paper(self) -> CircleCost:
        """Return a cost of the same circle with the paper's terms alone."""
        return replace(self, progress_weight=0.0, terminal_m=0.0, against_m=0.0)

    def prepare(
        self, time_s: float, x_m: float, y_m: float, yaw_rad: float, memory: float | None, step_s: float, horizon: int,
        x_icr_m: float = 0.0,
    ) -> Prepared:  # fmt: skip
        """Return kernel terms, the same at every time and place; the rollouts' memory is the angle swept (rad)."""
        return _prepared(self, step_s, horizon, x_icr_m)

    def line_m(self) -> Array:
        """Return the circle as points (N, 2), counter-clockwise and closed."""
        angle = np.linspace(0.0, 2.0 * math.pi, 361)
        return np.array([self.center_x_m, self.center_y_m]) + self.radius_m * np.column_stack(
            [np.cos(angle), np.sin(angle)]
        )


class CircleTerms(NamedTuple):
    """The cost round the origin.

    Radius (m), speed (m/s); weight of lost progress, progress wanted by the end of the horizon (m/s times steps),
    progress of a radian (m/s), largest reciprocal square of the radius; weight of the last distance, and of the last
    heading's error (m); what facing against the way costs (m). `turned_cos`, `turned_sin`: how far the robot's heading
    is turned inwards from the way that the tracked point goes.
    """

    radius_m: float
    speed_m_s: float
    progress_weight: float
    desired: float
    per_rad: float
    closest: float
    terminal_steps: float
    terminal_turn_m: float
    against_m: float
    turned_cos: float
    turned_sin: float

    def place_of(self, place: float, x: float, y: float) -> float:
        """Angle of a position about the centre (rad)."""
        return math.atan2(y, x)

    def line_at(self, place: float, ahead_m: float) -> tuple[float, float, float, float, float, float]:
        """Return x, y, heading (cosine, sine), cosine of heading against circle, and speed, `ahead_m` further on."""
        angle = place + ahead_m / self.radius_m
        cosine, sine = math.cos(angle), math.sin(angle)
        head_x = -sine * self.turned_cos - cosine * self.turned_sin
        head_y = cosine * self.turned_cos - sine * self.turned_sin
        return self.radius_m * cosine, self.radius_m * sine, head_x, head_y, self.turned_cos, self.speed_m_s

    def stage(
        self, memory: float, step: int, x_old: float, y_old: float, x: float, y: float,
        cos_yaw: float, sin_yaw: float, forward: float, found: Found,
    ) -> tuple[float, float]:  # fmt: skip
        """Return the paper's c, and the angle swept about the centre (rad).

        Near the centre steps count less than theirs.
        """
        rho, inverse = norm_and_inverse(x, y)
        off_edge = rho - self.radius_m
        off_speed = forward - self.speed_m_s
        swept = memory + (x_old * y - y_old * x) * min(inverse * inverse, self.closest)
        along = (x * sin_yaw - y * cos_yaw) * inverse
        against = self.against_m * max(-along, _ZERO)
        return math.sqrt(off_edge * off_edge + off_speed * off_speed) + against, swept

    def terminal(self, memory: float, x: float, y: float, cos_yaw: float, sin_yaw: float, found: Found) -> float:
        """Return the weighted cost (m) of missing progress, of the last distance to the edge and of the heading."""
        shortfall = self.progress_weight * max(self.desired - memory * self.per_rad, _ZERO)
        rho, inverse = norm_and_inverse(x, y)
        along, inwards = (x * sin_yaw - y * cos_yaw) * inverse, -(x * cos_yaw + y * sin_yaw) * inverse
        turn = abs(inwards * self.turned_cos - along * self.turned_sin)
        turn = turn if along * self.turned_cos + inwards * self.turned_sin > _ZERO else _TWO - turn
        return shortfall + self.terminal_steps * norm(rho - self.radius_m, self.terminal_turn_m * turn)


def inwards_sine(radius_m: float, x_icr_m: float) -> float:
    """Sine by which a robot that goes round a circle is turned inwards from the way of its tracked point."""
    return min(max(x_icr_m / radius_m, -MOST_TURNED), MOST_TURNED)


@lru_cache(maxsize=16)
def _prepared(circle: CircleCost, step_s: float, horizon: int, x_icr_m: float) -> Prepared:
    turned_sin = inwards_sine(circle.radius_m, x_icr_m)
    numbers = (
        circle.radius_m,
        circle.speed_m_s,
        circle.progress_weight,
        circle.progress_part * circle.speed_m_s * horizon,
        circle.radius_m / step_s,
        (NEAR_CENTRE / circle.radius_m) ** 2,
        circle.terminal_m / (circle.speed_m_s * step_s),
        TURN_WEIGHT * abs(x_icr_m),
        circle.against_m,
        math.sqrt(1.0 - turned_sin**2),
        turned_sin,
    )
    return Prepared(CircleTerms(*map(single, numbers)), (circle.center_x_m, circle.center_y_m))
