"""Classical path followers, against which DISCO is measured and which can drive on when it finds no plan.

A follower has the reference along the line, the place on it and the wheels of a motion; a steering law (pure pursuit,
Kanayama's, a linear-quadratic regulator) says how it turns. All laws act on the centre of rotation, which moves as a
unicycle, beside the reference motion of `Reference`; the integral is of the tracked point's distance from the line.
Gains are what a simplex search on five training robots found, at 0.2 m/s; faster robots have the same bandwidth in
time, as their wheels change speed and answer no sooner. Those of the regulator are chosen. `WithFallback` lets one take
over for as long as DISCO finds nothing valid, where robot.toml asks for one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_are

from disco_hw.control.disco import Disco
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import (
    CommandLimits,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Rollouts,
    WheelPlan,
    constant_plan,
    no_rollouts,
)
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import Belief
from disco_hw.tasks import PlannedTask
from disco_hw.tasks.line.course import SMALLEST_X_ICR_M, stable_yaw

Array = NDArray[np.float64]

GAINS_SPEED_M_S = 0.2
"""Speed at which, and below which, the gains of the laws hold as they stand."""
# Chosen: after a longer pause the integral goes on as if that much had passed.
_LONGEST_GAP_S = 0.2


def wheels_of(chassis: SteeredChassis, forward_m_s: float, turn_rad_s: float) -> Array:
    """Wheel speeds (2,), left and right (rad/s), of a motion."""
    half = 0.5 * chassis.axial_distance_m * turn_rad_s
    return np.array([forward_m_s - half, forward_m_s + half]) / chassis.wheel_radius_m


@dataclass(frozen=True, slots=True)
class Errors:
    """Tracking errors of the robot against its reference.

    `place`: index of the point on the reference. `left_m`, `yaw_rad`: how far the centre of rotation is to the left of
    its reference, and turned anticlockwise from it. `off_m`: distance of the tracked point to the left of the line;
    `sum_m_s`: its integral over time.
    """

    place: int
    left_m: float
    yaw_rad: float
    off_m: float
    sum_m_s: float


class Follower:
    """Drives a line by a steering law: a planner without a belief.

    The reference's wheel speeds are led by what the motors lag, and lifted over the dead band.
    """

    def __init__(self, reference: Reference, law: Law, chassis: SteeredChassis, limits: CommandLimits) -> None:
        self._reference, self._law, self._chassis, self._limits = reference, law, chassis, limits
        self.reset()

    def reset(self) -> None:
        """Forget the place on the line and the integral."""
        self._place: int | None = None
        self._sum_m_s = 0.0
        self._last_ns: int | None = None

    def set_chassis(self, chassis: SteeredChassis) -> None:
        """Steer this robot from now on; the line's headings, and the centre of rotation that they are for, stay."""
        self._chassis = chassis._replace(x_icr_m=self._chassis.x_icr_m)

    def watch(self, state: PlannerState) -> None:
        """Update only the place on the line while something else drives.

        Where the line crosses itself, nothing else tells the branches apart.
        """
        self._place = self._reference.place(state.x_m, state.y_m, self._place)
        self._sum_m_s, self._last_ns = 0.0, None

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Wheel speeds to hold from now on."""
        reference, law, chassis = self._reference, self._law, self._chassis
        self._place = reference.place(state.x_m, state.y_m, self._place)
        errors = self._errors(now_ns, self._place, state)
        spacing_s = reference.spacing_m / reference.speed_m_s
        here = reference.ahead(self._place, law.preview_s * reference.speed_m_s)
        there = reference.beyond(here, np.array([round(0.1 / spacing_s)])).item()
        add, factor = law.turn(reference, errors, state.x_m, state.y_m, state.yaw_rad)
        wheels = self._reference_wheels(here)
        change = (self._reference_wheels(there) - wheels) / 0.1
        now = wheels_of(chassis, reference.forward_m_s[here] * factor, reference.turn_rad_s[here] + add)
        commands = now + chassis.response_s * change
        commands += np.copysign(chassis.dead_rad_s, commands) * np.minimum(np.abs(commands) / 0.05, 1.0)
        # Too fast for a wheel: as fast as it can, on the same curve.
        commands /= max(1.0, float(np.abs(commands).max()) / self._limits.speed_rad_s)
        return constant_plan(now_ns, state, float(commands[0]), float(commands[1]), chassis[:3])

    def _reference_wheels(self, place: int) -> Array:
        return wheels_of(self._chassis, self._reference.forward_m_s[place], self._reference.turn_rad_s[place])

    def _errors(self, now_ns: int, place: int, state: PlannerState) -> Errors:
        reference, x_icr = self._reference, self._chassis.x_icr_m
        off = reference.offset_m(place, state.x_m, state.y_m)
        if self._last_ns is not None:
            self._sum_m_s += off * min((now_ns - self._last_ns) * 1e-9, _LONGEST_GAP_S)
        self._last_ns = now_ns
        largest = self._law.largest_sum_m_s
        self._sum_m_s = min(max(self._sum_m_s, -largest), largest)
        at_x, at_y = reference.axle_m(place)
        yaw = float(reference.yaw_rad[place])
        to_x = state.x_m + x_icr * math.cos(state.yaw_rad) - at_x
        to_y = state.y_m + x_icr * math.sin(state.yaw_rad) - at_y
        left = to_y * math.cos(yaw) - to_x * math.sin(yaw)
        return Errors(place, left, math.remainder(state.yaw_rad - yaw, 2.0 * math.pi), off, self._sum_m_s)

    def set_task(self, _task: object) -> None:
        """Raise TypeError, because a follower keeps its line."""
        raise TypeError("a follower keeps its line")

    def set_belief(self, _belief: object) -> None:
        """Do nothing: a follower uses no belief over parameters."""

    def sampled_rollouts(self, _count: int) -> Rollouts:
        """Return no rollouts: a follower samples none."""
        return no_rollouts()


# Chosen: smaller finds a nearer place on the line, and looks at more.
SPACING_M = 0.01
# Chosen: where the robot may be since the last place; further, a path that crosses itself would be taken elsewhere.
LOOK_BACK_M, LOOK_AHEAD_M = 0.3, 0.6


class Reference:
    """Way-points (N, 2) m driven at `speed_m_s` by a robot of this `x_icr_m`; closed if the last one is the first.

    `places_m` (M, 2), `along_rad`, `yaw_rad`, `forward_m_s` and `turn_rad_s` (M,) at equal distances `spacing_m`.
    """

    def __init__(self, waypoints_m: Array, speed_m_s: float, x_icr_m: float) -> None:
        self.speed_m_s, self.x_icr_m = speed_m_s, x_icr_m
        behind = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints_m, axis=0).T))])
        count = max(round(float(behind[-1]) / SPACING_M), 2)
        at = np.linspace(0.0, behind[-1], count + 1)
        places = np.column_stack([np.interp(at, behind, column) for column in waypoints_m.T])
        steps = np.diff(places, axis=0)
        self.places_m = places[:-1]
        self.spacing_m = float(behind[-1]) / count
        self.closed = bool(np.hypot(*(places[0] - places[-1])) < SPACING_M)
        self.along_rad = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        self.yaw_rad = stable_yaw(self.along_rad, self.spacing_m, x_icr_m, self.closed)[:-1]
        off = np.clip(self.yaw_rad - self.along_rad, -0.5 * math.pi, 0.5 * math.pi)
        self.forward_m_s = speed_m_s * np.cos(off)
        self.turn_rad_s = speed_m_s * np.sin(off) / math.copysign(max(abs(x_icr_m), SMALLEST_X_ICR_M), x_icr_m)

    def place(self, x_m: float, y_m: float, before: int | None) -> int:
        """Index of the place nearest to a position, near the one before."""
        count = len(self.places_m)
        if before is None:
            near = np.arange(count)
        else:
            back, ahead = round(LOOK_BACK_M / self.spacing_m), round(LOOK_AHEAD_M / self.spacing_m)
            near = self.beyond(before, np.arange(-back, ahead + 1))
        square = (self.places_m[near, 0] - x_m) ** 2 + (self.places_m[near, 1] - y_m) ** 2
        return int(near[int(square.argmin())])

    def beyond(self, place: int, entries: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return indices so many entries further on: round and round, or up to the ends."""
        count = len(self.places_m)
        return np.asarray((place + entries) % count if self.closed else np.clip(place + entries, 0, count - 1))

    def ahead(self, place: int, distance_m: float) -> int:
        """Index of the place so much further on."""
        return int(self.beyond(place, np.array([round(distance_m / self.spacing_m)]))[0])

    def offset_m(self, place: int, x_m: float, y_m: float) -> float:
        """Distance of a position to the left of the line at a place."""
        (at_x, at_y), along = self.places_m[place].tolist(), float(self.along_rad[place])
        return float((y_m - at_y) * math.cos(along) - (x_m - at_x) * math.sin(along))

    def axle_m(self, place: int) -> tuple[float, float]:
        """Return the position x, y (m) of the centre of rotation when the tracked point is at a place of the line."""
        (at_x, at_y), yaw = self.places_m[place].tolist(), float(self.yaw_rad[place])
        return at_x + self.x_icr_m * math.cos(yaw), at_y + self.x_icr_m * math.sin(yaw)


@dataclass(frozen=True, slots=True)
class PurePursuit:
    """Turn towards the reference further on (Coulter 1992), and against the integral if any.

    Above 0.2 m/s `look_ahead_m` is more in proportion to the speed, and `integral` less by its square.
    """

    look_ahead_m: float = 0.14
    integral: float = 0.0
    preview_s: float = 0.11
    largest_sum_m_s: float = 0.3

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """Return the arc through the goal, less the reference's."""
        faster = max(reference.speed_m_s / GAINS_SPEED_M_S, 1.0)
        goal_x, goal_y = reference.axle_m(reference.ahead(errors.place, faster * self.look_ahead_m))
        axle_x, axle_y = x_m + reference.x_icr_m * math.cos(yaw_rad), y_m + reference.x_icr_m * math.sin(yaw_rad)
        to_x, to_y = goal_x - axle_x, goal_y - axle_y
        left = to_y * math.cos(yaw_rad) - to_x * math.sin(yaw_rad)
        arc = 2.0 * left / max(to_x * to_x + to_y * to_y, 1e-4)
        desired = float(reference.forward_m_s[errors.place]) * arc
        desired -= self.integral * reference.speed_m_s * errors.sum_m_s / faster**2
        return desired - float(reference.turn_rad_s[errors.place]), 1.0


@dataclass(frozen=True, slots=True)
class Kanayama:
    """omega = omega_r - v_r (left e + yaw sin e_yaw + integral of e), e to the left (Kanayama et al. 1990).

    Above 0.2 m/s `yaw` is less in proportion to the speed, and `left` and `integral` to its square.
    """

    left: float = 184.0
    yaw: float = 15.7
    integral: float = 0.31
    preview_s: float = 0.12
    largest_sum_m_s: float = 0.3

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """Return Kanayama's turning correction (rad/s), and the cosine of the heading error as speed factor."""
        slower = min(GAINS_SPEED_M_S / reference.speed_m_s, 1.0)
        off = self.left * errors.left_m + self.integral * errors.sum_m_s
        correction = slower * (slower * off + self.yaw * math.sin(errors.yaw_rad))
        return -reference.speed_m_s * correction, max(math.cos(errors.yaw_rad), 0.2)


@dataclass(frozen=True, slots=True)
class LinearQuadratic:
    """State feedback of (integral, distance, yaw) that is optimal for these weights against turning, by length driven.

    e' = yaw, yaw' = correction, sum' = e over the length, from the continuous Riccati equation. Above 0.2 m/s these
    are less by the first, second and third power of the speed, of yaw, distance and integral.
    """

    sum_weight: float = 100.0
    left_weight: float = 200.0
    yaw_weight: float = 20.0
    preview_s: float = 0.1
    largest_sum_m_s: float = 0.3
    gains: tuple[float, float, float] = field(init=False)

    def __post_init__(self) -> None:
        dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        control = np.array([[0.0], [0.0], [1.0]])
        weights = np.diag([self.sum_weight, self.left_weight, self.yaw_weight])
        riccati = solve_continuous_are(dynamics, control, weights, np.eye(1))
        integral, left, yaw = (control.T @ riccati)[0].tolist()
        object.__setattr__(self, "gains", (integral, left, yaw))

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """Return the gains times the state (rad/s), and the cosine of the heading error as speed factor."""
        integral, left, yaw = self.gains
        slower, length = min(GAINS_SPEED_M_S / reference.speed_m_s, 1.0), reference.speed_m_s * errors.sum_m_s
        off = slower * integral * length + left * errors.left_m
        correction = slower * (slower * off + yaw * math.sin(errors.yaw_rad))
        return -reference.speed_m_s * correction, max(math.cos(errors.yaw_rad), 0.2)


Law = PurePursuit | Kanayama | LinearQuadratic
"""A steering law. `preview_s`: the time (s) by which the reference motion is taken ahead of the robot;
`largest_sum_m_s`: bound of the distance's integral. `turn` returns the correction to add to the reference's turning
rate (rad/s), and the factor of its forward speed."""

LAWS: Mapping[str, Callable[[], Law]] = MappingProxyType(
    {"pure_pursuit": PurePursuit, "kanayama": Kanayama, "lqr": LinearQuadratic}
)
"""By the names of `control.fallback`."""


@runtime_checkable
class Line(Protocol):
    """A planned task along a line at one speed."""

    @property
    def speed_m_s(self) -> float:
        """Speed along the line, m/s."""

    def line_m(self) -> Array:
        """Return the line's points (N, 2) in the order of the drive; the last is the first where it is closed."""


class WithFallback:
    """Plans as `planner` does; where that finds nothing valid, a follower by `law` drives on along the line.

    Its plans have the outcome FALLBACK. The planner is asked in every tick all the same, and has the robot back with
    its first valid plan. From a state that is not finite nobody drives: the planner's ramp to zero stays. Raises
    TypeError for a task without a line.
    """

    def __init__(self, planner: Disco, law: Callable[[], Law], task: PlannedTask, limits: CommandLimits) -> None:
        self._planner, self._law, self._limits = planner, law, limits
        self._follower = self._along(task)

    def _along(self, task: PlannedTask) -> Follower:
        if not isinstance(task, Line):
            raise TypeError(f"{type(task).__name__} has no line that a follower could drive")
        reference = Reference(task.line_m(), task.speed_m_s, self._planner.chassis.x_icr_m)
        return Follower(reference, self._law(), self._planner.chassis, self._limits)

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Return the planner's plan, or the follower's; raises NoValidControl where neither can be."""
        numbers = state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s
        finite = all(map(math.isfinite, numbers))
        try:
            plan = self._planner.plan(now_ns, state)
        except NoValidControl:
            # A law that knows the line alone would drive into what the planner stops for.
            if not finite or self._planner.is_trapped:
                raise
        else:
            if self._planner.is_trapped:
                return plan
            if plan.diagnostics.outcome is not PlanOutcome.STOPPING:
                self._follower.watch(state)
                return plan
            if not finite:
                return plan
        steered = self._follower.plan(now_ns, state)
        found = msgspec.structs.replace(steered.diagnostics, outcome=PlanOutcome.FALLBACK)
        return msgspec.structs.replace(steered, diagnostics=found)

    def reset(self) -> None:
        """Forget the last plan and the place on the line."""
        self._planner.reset()
        self._follower.reset()

    def set_task(self, task: PlannedTask) -> None:
        """Plan and follow another task of the same kind."""
        self._planner.set_task(task)
        self._follower = self._along(task)

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief, and steer a robot of its mean; the line's headings stay. Raises ValueError."""
        self._planner.set_belief(belief)
        self._follower.set_chassis(self._planner.chassis)

    def look_around(self, bounds: Boundaries, deviation_m: float) -> None:
        """Let the planner keep away from these boundaries; the law knows nothing of them, and the guard stops it."""
        self._planner.look_around(bounds, deviation_m)

    def set_line(self, line_m: Array) -> None:
        """Let the planner drive around what stands on this line, points (N, 2)."""
        self._planner.set_line(line_m)

    def sampled_rollouts(self, count: int) -> Rollouts:
        """Return the planner's, of its last plan."""
        return self._planner.sampled_rollouts(count)
