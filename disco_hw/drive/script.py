"""A scripted drive: manoeuvres one after the other, each wheel speeds as a function of time; pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from disco_hw.config import Robot

Wheels = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """Wheel speeds (rad/s, left and right) over the time since its start (s), and what inference learns from it.

    `finds_limits`: the wheels' limits are what it reaches; `within_limits`: its speeds are scaled into those found.
    """

    name: str
    purpose: str
    duration_s: float
    wheels: Callable[[float], Wheels]
    finds_limits: bool = False
    within_limits: bool = False


@dataclass(frozen=True, slots=True)
class Script:
    """Manoeuvres in order; raises ValueError without any."""

    name: str
    manoeuvres: tuple[Manoeuvre, ...]

    def __post_init__(self) -> None:
        if not self.manoeuvres:
            raise ValueError("a script needs at least one manoeuvre")

    @property
    def duration_s(self) -> float:
        """Duration of all manoeuvres."""
        return math.fsum(manoeuvre.duration_s for manoeuvre in self.manoeuvres)

    def at(self, t_s: float) -> Wheels:
        """Wheel speeds at a time since the start; zero before it and from the end on."""
        place = self.place(t_s)
        return (0.0, 0.0) if place is None else place[0].wheels(t_s - place[1])

    def place(self, t_s: float) -> tuple[Manoeuvre, float] | None:
        """The manoeuvre under way at a time and when it began (s); None before the start and from the end on."""
        start_s = 0.0
        for manoeuvre in self.manoeuvres if t_s >= 0.0 else ():
            if t_s < start_s + manoeuvre.duration_s:
                return manoeuvre, start_s
            start_s += manoeuvre.duration_s
        return None

    def cut(self, seconds: float) -> Script:
        """The script broken off after so long."""
        kept: list[Manoeuvre] = []
        left_s = seconds
        for manoeuvre in self.manoeuvres:
            if left_s <= 0.0:
                break
            kept.append(replace(manoeuvre, duration_s=min(left_s, manoeuvre.duration_s)))
            left_s -= manoeuvre.duration_s
        return Script(self.name, tuple(kept))


@dataclass(frozen=True, slots=True)
class Room:
    """Where a drive leads from its start, x forward and y left (m)."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]

    def in_words(self) -> str:
        """The room for a person."""
        return (
            f"about {self.x_m[1]:.1f} m ahead, {abs(self.x_m[0]):.1f} m behind, {self.y_m[1]:.1f} m to the left and "
            f"{abs(self.y_m[0]):.1f} m to the right of the tracked point"
        )


def room_needed(wheels: Callable[[float], Wheels], duration_s: float, robot: Robot, step_s: float = 0.02) -> Room:
    """The room that a drive takes on a robot with exactly the nominal geometry; a real one needs more."""
    x_m = y_m = yaw_rad = 0.0
    xs, ys = [0.0], [0.0]
    for k in range(math.ceil(duration_s / step_s)):
        left, right = wheels(k * step_s)
        travel_m = 0.5 * robot.wheel_radius_m * (left + right) * step_s
        turn_rad = robot.wheel_radius_m * (right - left) / robot.axial_distance_m * step_s
        x_m += travel_m * math.cos(yaw_rad + 0.5 * turn_rad)
        y_m += travel_m * math.sin(yaw_rad + 0.5 * turn_rad)
        yaw_rad += turn_rad
        xs.append(x_m)
        ys.append(y_m)
    return Room((min(xs), max(xs)), (min(ys), max(ys)))


def in_table(script: Script) -> Sequence[str]:
    """One line a manoeuvre: when it begins, what it is called, what it is for."""
    lines = []
    start_s = 0.0
    for manoeuvre in script.manoeuvres:
        lines.append(f"{start_s:6.1f} s  {manoeuvre.name:<28} {manoeuvre.purpose}")
        start_s += manoeuvre.duration_s
    return lines
