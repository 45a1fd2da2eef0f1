"""Scripted drive of manoeuvres one after the other, each wheel speeds as a function of time; pure.

Manoeuvres are shares of the largest wheel speed that the robot reaches, which is measured first: the fastest, both
ways, straight and turning. The script's clock runs while the robot is driven; the deadman is somebody else's.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import Robot
from disco_hw.drive import ManualInput, ManualSource, RobotView
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.runtime import State

Array = NDArray[np.float64]
Pose = tuple[float, float, float]
Wheels = tuple[float, float]
STANDING: Wheels = (0.0, 0.0)
# Chosen: shorter finds a smaller excursion between two points, and takes longer.
_STEP_S = 0.05


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
    """Sequence of named manoeuvres; raises ValueError without any."""

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
        return STANDING if place is None else place[0].wheels(t_s - place[1])

    def place(self, t_s: float) -> tuple[Manoeuvre, float] | None:
        """Return the manoeuvre under way at a time and when it began (s); None before the start and from the end on."""
        start_s = 0.0
        for manoeuvre in self.manoeuvres if t_s >= 0.0 else ():
            if t_s < start_s + manoeuvre.duration_s:
                return manoeuvre, start_s
            start_s += manoeuvre.duration_s
        return None

    def over(self, t_s: float) -> int:
        """Return how many manoeuvres are over at a time since the start."""
        count, end_s = 0, 0.0
        for manoeuvre in self.manoeuvres:
            end_s += manoeuvre.duration_s
            count += t_s >= end_s
        return count

    def cut(self, seconds: float) -> Script:
        """Return the script broken off after so long."""
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
    """Extent of a drive from its start, x forward and y left (m)."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]

    def describe(self) -> str:
        """Return the room as text."""
        return (
            f"about {self.x_m[1]:.1f} m ahead, {abs(self.x_m[0]):.1f} m behind, {self.y_m[1]:.1f} m to the left and "
            f"{abs(self.y_m[0]):.1f} m to the right of the tracked point"
        )


@dataclass(frozen=True, slots=True)
class RobotModel:
    """Robot that does what it is told, as fast as the governor lets its wheels change their speed."""

    geometry: OdometryParameters
    max_wheel_acceleration_rad_s2: float

    def ramped(self, manoeuvre: Manoeuvre, count: int, running: Wheels) -> Array:
        """Wheel speeds (count, 2) that the governor sends in each step of a manoeuvre that begins with `running`."""
        step_s = manoeuvre.duration_s / count
        most = self.max_wheel_acceleration_rad_s2 * step_s
        left, right = running
        speeds = []
        for k in range(count):
            desired = manoeuvre.wheels((k + 0.5) * step_s)
            change = max(abs(desired[0] - left), abs(desired[1] - right))
            # Along the straight line in wheel space, as far as the slower wheel allows.
            share = most / change if change > most else 1.0
            left += share * (desired[0] - left)
            right += share * (desired[1] - right)
            speeds.append((left, right))
        return np.array(speeds)


def driven_path(
    manoeuvre: Manoeuvre, start: Pose, robot: RobotModel, running: Wheels = STANDING
) -> tuple[Array, Wheels]:
    """Poses (N, 3) of the tracked point over a manoeuvre, and the wheel speeds at its end.

    `running`: the wheel speeds at its beginning.
    """
    count = max(1, math.ceil(manoeuvre.duration_s / _STEP_S))
    step_s, body = manoeuvre.duration_s / count, robot.geometry
    wheels = robot.ramped(manoeuvre, count, running)
    moved = 0.5 * body.wheel_radius_m * wheels.sum(axis=1) * step_s
    turned = body.wheel_radius_m * (wheels[:, 1] - wheels[:, 0]) / body.axial_distance_m * step_s
    yaw = start[2] + np.concatenate(([0.0], np.cumsum(turned)))
    middle = yaw[:-1] + 0.5 * turned
    x = start[0] + body.x_icr_m * math.cos(start[2]) + np.concatenate(([0.0], np.cumsum(moved * np.cos(middle))))
    y = start[1] + body.x_icr_m * math.sin(start[2]) + np.concatenate(([0.0], np.cumsum(moved * np.sin(middle))))
    path = np.stack([x - body.x_icr_m * np.cos(yaw), y - body.x_icr_m * np.sin(yaw), yaw], axis=1)
    left, right = wheels[-1].tolist()
    return path, (left, right)


def stopping_path(start: Pose, robot: RobotModel, running: Wheels) -> Array:
    """Poses (N, 3) of the tracked point while the wheels come to a standstill."""
    stop_s = max(map(abs, running)) / robot.max_wheel_acceleration_rad_s2
    return driven_path(Manoeuvre("stop", "", stop_s, lambda _t_s: STANDING), start, robot, running)[0]


def room_needed(script: Script, robot: Robot) -> Room:
    """Return the room that a script takes on a robot with exactly the nominal geometry; a real one needs more."""
    geometry = OdometryParameters(robot.wheel_radius_m, robot.axial_distance_m, robot.x_icr_m)
    model = RobotModel(geometry, robot.max_wheel_acceleration_rad_s2)
    paths, running = [np.zeros((1, 3))], STANDING
    for manoeuvre in script.manoeuvres:
        path, running = driven_path(manoeuvre, end_of(paths[-1]), model, running)
        paths.append(path)
    # One that is broken off ends with its wheels running.
    paths.append(stopping_path(end_of(paths[-1]), model, running))
    x, y = np.concatenate(paths)[:, :2].T
    return Room((float(x.min()), float(x.max())), (float(y.min()), float(y.max())))


def end_of(path: Array) -> Pose:
    """Return the last pose of a path."""
    x_m, y_m, yaw_rad = path[-1].tolist()
    return x_m, y_m, yaw_rad


def in_table(script: Script) -> Sequence[str]:
    """One line a manoeuvre: when it begins, what it is called, what it is for."""
    lines = []
    start_s = 0.0
    for manoeuvre in script.manoeuvres:
        lines.append(f"{start_s:6.1f} s  {manoeuvre.name:<28} {manoeuvre.purpose}")
        start_s += manoeuvre.duration_s
    return lines


Profile = Callable[[float], tuple[float, float]]
# Chosen: longer than the shipped robot's wheels take to stop; longer rests lengthen every script.
REST_S = 0.6
# Chosen: for wheels that follow their ramp late.
_SPARE_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Pieces:
    """Manoeuvres as shares of `top_rad_s`: (forward, turn to the left).

    Rests and held ones are longer where the wheels take longer than REST_S to stop or to reach their speed.
    """

    top_rad_s: float
    max_wheel_acceleration_rad_s2: float = math.inf

    def extra_s(self, share: float) -> float:
        """Return by how much a ramp to a share of the speed takes longer than REST_S, in tenths of a second; or 0."""
        ramp_s = share * self.top_rad_s / self.max_wheel_acceleration_rad_s2
        return max(0, math.ceil(10.0 * ((1.0 + _SPARE_SHARE) * ramp_s - REST_S))) / 10.0

    def rest(
        self, duration_s: float = REST_S, purpose: str = "separates what comes before from what comes after"
    ) -> Manoeuvre:
        """Create a manoeuvre that stands still, after one of any share."""
        return Manoeuvre("rest", purpose, duration_s + self.extra_s(1.0), lambda _t_s: STANDING)

    def play(self, name: str, purpose: str, duration_s: float, profile: Profile) -> Manoeuvre:
        """Shares as a function of the time since its start (s)."""

        def wheels(t_s: float) -> tuple[float, float]:
            forward, turn = profile(t_s)
            return (forward - turn) * self.top_rad_s, (forward + turn) * self.top_rad_s

        return Manoeuvre(name, purpose, duration_s, wheels)

    def hold(self, name: str, purpose: str, duration_s: float, forward: float, turn: float) -> Manoeuvre:
        """Create a manoeuvre of constant shares."""
        longer_s = duration_s + self.extra_s(abs(forward) + abs(turn))
        return self.play(name, purpose, longer_s, lambda _t_s: (forward, turn))

    def each(self, purpose: str, *state: tuple[str, float, float, float]) -> list[Manoeuvre]:
        """Several held ones (name, duration, forward, turn), each followed by a rest."""
        return [part for one in state for part in (self.hold(one[0], purpose, *one[1:]), self.rest())]


# Five periods at 50 Hz: after a longer pause of the loop the script goes on from where it was.
_LONGEST_TICK_NS = 100_000_000
# Chosen: the end of a manoeuvre, at which its speed is reached if it ever is.
_SETTLED_S = 0.8


class ScriptSource:
    """Plays a script while the deadman of another source is held.

    A manoeuvre that was broken off by disarming begins again when driving goes on, so that each is recorded whole once.
    The wheels' limits are what they reach at the end of the manoeuvres that are to find them.
    """

    def __init__(self, script: Script, deadman: ManualSource) -> None:
        self._script = script
        self._deadman = deadman
        self._driven_ns = 0
        self._last_ns: int | None = None
        self._driven = False
        self._driving = False
        self._restarts = 0
        self.completed = False
        """Whether the script was played to its end."""
        self._fenced = ""
        self._limits = ReachedLimits()

    @property
    def ended(self) -> str | None:
        """The end of the script or of the source of the deadman."""
        if self._fenced:
            return (
                f"the fence stopped the script {self._script.name} in {self._fenced}; the event before this one "
                "says where"
            )
        return f"script {self._script.name} completed" if self.completed else self._deadman.ended

    @property
    def status_text(self) -> str:
        """Text for the operator on the script's progress, and on what to do where nothing moves."""
        progress = f"{self._driven_ns * 1e-9:.0f} of {self._script.duration_s:.0f} s"
        manoeuvre = self._manoeuvre
        name = "" if manoeuvre is None else f", {manoeuvre.name}"
        state = "" if self._driving else f"; {self._deadman.status_text}"
        return f"{progress}{name}{state}"

    @property
    def task(self) -> str:
        """The manoeuvre under way, or next, and the limits that it keeps where it is about them."""
        manoeuvre = self._manoeuvre
        if manoeuvre is None:
            return ""
        limits = f" ({self._limits.describe()})" if manoeuvre.within_limits else ""
        return f"{manoeuvre.name}{limits}: {manoeuvre.purpose}"

    @property
    def finished(self) -> int:
        """Number of manoeuvres that are over."""
        return self._script.over(self._driven_ns * 1e-9)

    @property
    def begun(self) -> tuple[int, int]:
        """Numbers that change whenever a manoeuvre begins, or begins again."""
        return self.finished, self._restarts

    @property
    def remaining(self) -> tuple[Manoeuvre, ...]:
        """The manoeuvre under way and those after it."""
        return self._script.manoeuvres[self.finished :]

    def replace_remaining(self, manoeuvres: tuple[Manoeuvre, ...]) -> None:
        """Play these in place of those that remain, from the beginning of the first."""
        past = self._script.manoeuvres[: self.finished]
        self._script = Script(self._script.name, (*past, *manoeuvres))
        self._driven_ns = math.ceil(math.fsum(one.duration_s for one in past) * 1e9)
        # The time that the fit took is none of the manoeuvre's.
        self._last_ns = None

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """Return the script's wheel speeds with the other source's deadman and time."""
        state = self._deadman.poll(now_ns, robot)
        self._advance(now_ns, robot)
        if state is None:
            return None
        if self.completed or self._fenced:
            return ManualInput(now_ns, 0.0, 0.0, deadman=False)
        left, right = self._wheels()
        return ManualInput(state.t_ns, left, right, state.deadman)

    def close(self) -> None:
        """Close the source of the deadman."""
        self._deadman.close()

    @property
    def _manoeuvre(self) -> Manoeuvre | None:
        place = self._script.place(self._driven_ns * 1e-9)
        return None if place is None else place[0]

    def _wheels(self) -> Wheels:
        wheels = self._script.at(self._driven_ns * 1e-9)
        manoeuvre = self._manoeuvre
        return self._limits.within(wheels) if manoeuvre is not None and manoeuvre.within_limits else wheels

    def _observe(self, measured: Wheels | None) -> None:
        """Learn what the wheels reach, from the end of a manoeuvre that is to find it."""
        t_s = self._driven_ns * 1e-9
        place = self._script.place(t_s)
        if measured is None or place is None or not place[0].finds_limits:
            return
        manoeuvre, began_s = place
        if t_s > began_s + manoeuvre.duration_s - _SETTLED_S:
            self._limits.observe(manoeuvre.name, manoeuvre.wheels(t_s - began_s), measured)

    def _advance(self, now_ns: int, robot: RobotView) -> None:
        manoeuvre = self._manoeuvre
        if robot.driving and robot.fence_stopped and manoeuvre is not None:
            self._fenced = manoeuvre.name
        if robot.driving and self._last_ns is not None:
            # A loop held up must not skip what was to be driven meanwhile.
            self._driven_ns += min(now_ns - self._last_ns, _LONGEST_TICK_NS)
            self.completed = self.completed or self._manoeuvre is None
            self._driven = True
            self._observe(robot.wheels)
        elif self._driven and robot.state is not State.ARMED and not self.completed:
            place = self._script.place(self._driven_ns * 1e-9)
            self._driven_ns = 0 if place is None else round(place[1] * 1e9)
            self._driven = False
            self._restarts += 1
        self._driving = robot.driving
        self._last_ns = now_ns


class Unattended:
    """Holds the deadman by itself, once: for the virtual robot, and for tests.

    Pressed when the robot has become ready; if it does not drive within `driving_within_s`, then or after a hold while
    armed, or is disarmed by anybody, it is released for good. So it never ends as it should.
    """

    completed, task = False, ""

    def __init__(self, ready_within_s: float = 60.0, driving_within_s: float = 5.0) -> None:
        self._ready_within_ns = round(ready_within_s * 1e9)
        self._driving_within_ns = round(driving_within_s * 1e9)
        self._first_ns: int | None = None
        self._pressed_ns: int | None = None
        self._waiting_ns = 0
        self._driven = False
        self.ended: str | None = None
        """Reason why the deadman was released; None while it was not."""

    @property
    def status_text(self) -> str:
        """Text for the operator on what it waits for."""
        return "unattended: waiting for the robot" if self._pressed_ns is None else "unattended: deadman held"

    def poll(self, now_ns: int, robot: RobotView) -> ManualInput | None:
        """Return the deadman's state, with wheel speeds of zero."""
        if self._first_ns is None:
            self._first_ns = now_ns
        state = self._pressed_ns is not None and self.ended is None
        if self._pressed_ns is None:
            if robot.state is State.READY:
                # Held from the next tick on: a deadman counts only after it was seen open.
                self._pressed_ns = self._waiting_ns = now_ns
            elif now_ns - self._first_ns > self._ready_within_ns:
                self.ended = (
                    f"the robot was not ready within {self._ready_within_ns * 1e-9:g} s; `disco-hw ctl ROBOT.toml "
                    "status` says why"
                )
        elif robot.driving:
            self._driven, self._waiting_ns = True, now_ns
        elif self._driven and robot.state is not State.ARMED:
            self.ended = self.ended or "the robot was disarmed before the script was over"
        elif now_ns - self._waiting_ns > self._driving_within_ns:
            hold = f"the robot stood still for {self._driving_within_ns * 1e-9:g} s before the script was over"
            self.ended = self.ended or (hold if self._driven else "the robot did not start to drive")
        return ManualInput(now_ns, 0.0, 0.0, deadman=state)

    def close(self) -> None:
        """Do nothing, because the source holds no resources."""


KEPT = 0.95
"""Reached is what comes so close to what was asked."""

# All of the requested speed.
_LARGEST = 1.0


class ReachedLimits:
    """Shares of what was asked that each wheel reached forward and backward, in the manoeuvre where it reached least.

    Where nothing was observed, all of it counts as reached.
    """

    def __init__(self) -> None:
        self._shares: dict[tuple[int, bool], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        self._commanded: dict[tuple[int, bool], float] = {}

    def observe(self, manoeuvre: str, commanded: Wheels, measured: Wheels) -> None:
        """Take in wheel speeds (rad/s, left and right) after they had time to settle."""
        for wheel, (command, reached) in enumerate(zip(commanded, measured, strict=True)):
            if command != 0.0:
                self._shares[wheel, command > 0.0][manoeuvre].append(reached / command)
                self._commanded[wheel, command > 0.0] = command

    def share(self, wheel: int, *, forward: bool) -> float:
        """Return the reached share, in [0, 1], of the requested speed of wheel 0 (left) or 1 (right)."""
        found = [median(shares) for shares in self._shares[wheel, forward].values()]
        least = min(found, default=_LARGEST)
        return _LARGEST if not least < KEPT else max(0.0, least)

    def within(self, commanded: Wheels) -> Wheels:
        """Wheel speeds scaled into the limits that were found."""
        left, right = (speed * self.share(wheel, forward=speed > 0.0) for wheel, speed in enumerate(commanded))
        return left, right

    def describe(self) -> str:
        """Return the limits as text."""
        if len(self._commanded) < 4:
            return "limits not found: no wheel speeds were measured"
        reached = {key: commanded * self.share(key[0], forward=key[1]) for key, commanded in self._commanded.items()}
        left, right = (f"{reached[wheel, False]:+.1f} to {reached[wheel, True]:+.1f}" for wheel in (0, 1))
        return f"found: left {left}, right {right} rad/s"
