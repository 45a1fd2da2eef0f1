"""Pure pipeline of one tick: samples in, estimate, plan, governed wheel command out.

The real-time loop, the replay and the simulated-time harness run this same object; it has no clock, thread or I/O.

The governor holds the last limits before a command leaves the host: wheel speed, wheel acceleration, nothing that is
not a number. It is the second of three layers: the planner samples within bounds, the governor holds the wheels to them
whatever the planner says, and the firmware enforces its own.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.control import NoValidControl, PlannerState, PlanOutcome, Rollouts, SentCommand, WheelPlan
from disco_hw.control.past_motion import DriveMeans
from disco_hw.estimation import PoseEstimate, PoseFusion
from disco_hw.estimation.correction import PoseUpdate
from disco_hw.estimation.heading_watch import HeadingWatch
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import Belief
from disco_hw.model.drift import NO_DRIFT, Drift
from disco_hw.runtime.fence_guard import IDLE, STOPS_MOTION, FenceGuard, FenceState, corner_deviation_m
from disco_hw.tasks import PlannedTask
from drivers.types import Readings

# A tick that comes late may move the command by half a period more than usual, never by the whole time missed.
_LARGEST_STEP_PERIODS = 1.5


class Limited(enum.Flag):
    """Reasons why a command differs from what was desired; empty if it does not."""

    NONE = 0
    SPEED = enum.auto()
    ACCELERATION = enum.auto()
    PERIOD = enum.auto()
    NOT_FINITE = enum.auto()
    FENCE = enum.auto()


@dataclass(frozen=True, slots=True)
class WheelLimits:
    """Limits of each wheel: rad/s, and rad/s^2 away from and towards standstill; and of both, by how much they differ.

    `max_difference_rad_s`: of a controller that limits how fast the robot turns; infinite for one that does not.
    """

    max_speed_rad_s: float
    max_acceleration_rad_s2: float
    max_deceleration_rad_s2: float
    max_difference_rad_s: float = math.inf

    def __post_init__(self) -> None:
        for name in ("max_speed_rad_s", "max_acceleration_rad_s2", "max_deceleration_rad_s2"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} must be positive and finite, not {value}")
        if not self.max_difference_rad_s > 0.0:
            raise ValueError(f"max_difference_rad_s must be positive, not {self.max_difference_rad_s}")


class Governed(msgspec.Struct, frozen=True, gc=False):
    """The command that may be sent (rad/s, left before right) and why it is not the desired one."""

    left_rad_s: float
    right_rad_s: float
    limited: Limited


class Governor:
    """Holds wheel commands within limits, from the command sent last.

    Speed, and by how much the wheels differ: both are scaled by one factor, so the curvature of the path is kept.
    Acceleration: the command moves along the straight line in wheel space from the last command to the desired one, as
    far as the slower-limited wheel allows, so neither wheel exceeds its limit and the direction of the change is kept.
    """

    def __init__(self, limits: WheelLimits, period_s: float) -> None:
        if not (math.isfinite(period_s) and period_s > 0.0):
            raise ValueError(f"period_s must be positive and finite, not {period_s}")
        self._limits = limits
        self._largest_dt_s = _LARGEST_STEP_PERIODS * period_s
        self._left_rad_s = 0.0
        self._right_rad_s = 0.0

    def reset(self) -> None:
        """Start again from standstill; to be called when no command is being sent and the robot has stopped."""
        self._left_rad_s = 0.0
        self._right_rad_s = 0.0

    def step(self, desired_left_rad_s: float, desired_right_rad_s: float, dt_s: float) -> Governed:
        """Return the wheel speeds that the limits allow `dt_s` after the last command.

        A desired command that is not finite counts as standstill. A `dt_s` that is negative or not a
        number counts as none, one beyond 1.5 nominal periods as 1.5 periods.
        """
        limited = Limited.NONE
        left, right = desired_left_rad_s, desired_right_rad_s
        if not (math.isfinite(left) and math.isfinite(right)):
            limited |= Limited.NOT_FINITE
            left, right = 0.0, 0.0

        top = self._limits.max_speed_rad_s
        fastest = max(abs(left), abs(right))
        if fastest > top:
            limited |= Limited.SPEED
            # Dividing first keeps the faster wheel at exactly the limit: fastest / fastest is 1.
            left, right = left / fastest * top, right / fastest * top
        difference = abs(right - left)
        if difference > self._limits.max_difference_rad_s:
            limited |= Limited.SPEED
            share = self._limits.max_difference_rad_s / difference
            left, right = share * left, share * right

        # A NaN fails both comparisons of the clamp and counts as no time at all.
        dt = dt_s if 0.0 <= dt_s <= self._largest_dt_s else (self._largest_dt_s if dt_s > 0.0 else 0.0)
        if dt != dt_s:
            limited |= Limited.PERIOD

        fraction = min(
            1.0,
            self._allowed_fraction(self._left_rad_s, left, dt),
            self._allowed_fraction(self._right_rad_s, right, dt),
        )
        if fraction < 1.0:
            limited |= Limited.ACCELERATION
            left = self._left_rad_s + fraction * (left - self._left_rad_s)
            right = self._right_rad_s + fraction * (right - self._right_rad_s)
        self._left_rad_s, self._right_rad_s = left, right
        return Governed(left, right, limited)

    def _allowed_fraction(self, start: float, end: float, dt_s: float) -> float:
        """Return the part of the change from `start` to `end` that one wheel can make in `dt_s`; at least 1 if all."""
        change = abs(end - start)
        if change == 0.0:
            return 1.0
        if start * (end - start) >= 0.0:
            return self._limits.max_acceleration_rad_s2 * dt_s / change
        to_standstill_s = abs(start) / self._limits.max_deceleration_rad_s2
        if to_standstill_s >= dt_s:
            return self._limits.max_deceleration_rad_s2 * dt_s / change
        return (abs(start) + self._limits.max_acceleration_rad_s2 * (dt_s - to_standstill_s)) / change


# Chosen: commands are kept to predict from late samples, older ones only in the means; shorter than a delay would lose
# its commands.
HISTORY_NS = 2_000_000_000


class Planner(Protocol):
    """Whatever turns a state into a plan; DISCO is one."""

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Plan from the state; raises NoValidControl when there is nothing to execute."""

    def reset(self) -> None:
        """Forget the last plan, as at a new start."""

    def set_task(self, task: PlannedTask) -> None:
        """Plan for another task of the same kind from the next reset on."""

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief from the next plan on; raises ValueError, and keeps the old one, if it cannot."""

    def sampled_rollouts(self, count: int) -> Rollouts:
        """Return wheel speeds, trajectories (n, T + 1, 3) and weights of the last plan's sequences of largest weight.

        At most `count` of them; no plan is changed.
        """


@runtime_checkable
class AvoidsBoundaries(Protocol):
    """A planner that keeps away from fence and obstacles by itself."""

    def look_around(self, bounds: Boundaries, deviation_m: float) -> None:
        """Keep away from these boundaries from the next plan on.

        `deviation_m`: standard deviation of the footprint's corner whose position is known least.
        """

    def set_line(self, line_m: NDArray[np.float64]) -> None:
        """Drive around what stands on this line, points (N, 2)."""


class NoPlanner:
    """Planner that never has a plan, for a robot that is driven by hand."""

    def plan(self, _now_ns: int, _state: PlannerState) -> WheelPlan:
        """Raise NoValidControl: there is no planner."""
        raise NoValidControl("there is no planner: the robot is driven by hand")

    def reset(self) -> None:
        """Do nothing: no plan is kept."""

    def set_task(self, _task: PlannedTask) -> None:
        """Do nothing: the operator decides where to drive."""

    def set_belief(self, _belief: Belief) -> None:
        """Do nothing: nothing is planned with a belief."""

    def sampled_rollouts(self, _count: int) -> Rollouts:
        """Raise NoValidControl: there is no planner."""
        raise NoValidControl("there is no planner")


@dataclass(frozen=True, slots=True)
class Off:
    """Motion request under which nothing is sent to the wheels."""


@dataclass(frozen=True, slots=True)
class Standstill:
    """Come to zero wheel speed within the limits and hold it."""


@dataclass(frozen=True, slots=True)
class FollowTask:
    """Let the planner drive."""


@dataclass(frozen=True, slots=True)
class Manual:
    """Drive at these wheel speeds (rad/s, left and right), within the governor's limits."""

    left_rad_s: float
    right_rad_s: float


@dataclass(frozen=True, slots=True)
class Silent:
    """Send no frame at all, as a host that has died: the robot's own watchdog must stop it."""


class Source(enum.Enum):
    """Sources of the wheel speeds that are requested in a tick."""

    OFF = "off"
    """Motion is off: nothing is sent to the wheels."""
    HOLD = "hold"
    """Standstill is requested: zero speeds, to be reached within the limits and held."""
    PLAN = "plan"
    """This tick's new plan."""
    TAIL = "tail"
    """An older plan that is still in force, because this tick made none."""
    FALLBACK = "fallback"
    """This tick's new plan, whose outcome is FALLBACK: a classical follower made it."""
    RAMP = "ramp"
    """Zero speeds, because no plan is in force or its tail is over."""
    MANUAL = "manual"
    """Wheel speeds of an operator or a script."""
    SILENT = "silent"
    """No frame is sent at all."""


Motion = Off | Standstill | FollowTask | Manual | Silent


class Tick(msgspec.Struct, frozen=True, gc=False):
    """Result of the pipeline for one tick.

    `plan` is this tick's new plan or None, `planner_failure` why there is none; `requested` is what `source` wanted,
    `command` what the governor lets through (rad/s); `fence` what the fence guard made of what was requested.
    """

    t_ns: int
    pose_updates: tuple[PoseUpdate, ...]
    estimate: PoseEstimate
    plan: WheelPlan | None
    planner_failure: str | None
    source: Source
    requested: tuple[float, float]
    command: Governed
    fence: FenceState = IDLE


def untimed(_stage: str) -> None:
    """Do nothing instead of timing a stage, for callers without a clock."""


class Pipeline:
    """Estimator, planner and governor in one step.

    A plan that is late or missing is followed on its tail for `plan_tail_s` after the tick it was made for; then the
    wheels ramp to zero. The governor runs in every tick, so that stopping obeys the acceleration limit as well.
    `guard` checks every command.
    """

    def __init__(
        self, fusion: PoseFusion, planner: Planner, governor: Governor, plan_tail_s: float, guard: FenceGuard,
        means: DriveMeans | None = None, headings: HeadingWatch | None = None,
    ) -> None:  # fmt: skip
        self.guard = guard
        self._avoids = planner if isinstance(planner, AvoidsBoundaries) else None
        self.fusion = fusion
        self.headings = headings or HeadingWatch([one.label for one in fusion.sources.all])
        self._means = means
        self._drift, self._lateral_lag_s = NO_DRIFT, 0.0
        self._planner = planner
        self._governor = governor
        self._plan_tail_ns = round(plan_tail_s * 1e9)
        self._plan: WheelPlan | None = None
        self._plan_made_ns = 0
        self._following = False
        self._last_ns: int | None = None
        self._sent: deque[SentCommand] = deque()

    def set_task(self, task: PlannedTask, line_m: NDArray[np.float64] | None = None) -> None:
        """Follow another task of the same kind; what is planned for the present one is dropped.

        `line_m` (N, 2): its line, for a planner that drives around obstacles on it.
        """
        self._planner.set_task(task)
        if self._avoids is not None and line_m is not None:
            self._avoids.set_line(line_m)
        self._plan, self._following = None, False

    def set_belief(
        self, belief: Belief, odometry: OdometryParameters, drift_m_s: tuple[float, float] = (0.0, 0.0),
        lateral_lag_s: float = 0.0,
    ) -> None:  # fmt: skip
        """Plan and estimate with another geometry from the next step on; plan and estimate in force stay.

        `drift_m_s`: how fast the ground carries the moving robot along x and y of the world. `lateral_lag_s`: how long
        the body's sideways speed lags behind its turning. Raises ValueError, with everything as it was, if the planner
        cannot take the belief.
        """
        self._planner.set_belief(belief)
        self._drift = NO_DRIFT if drift_m_s == (0.0, 0.0) else Drift(*drift_m_s)
        self.fusion.set_drift(self._drift)
        self._lateral_lag_s = lateral_lag_s
        self.fusion.set_parameters(odometry)

    def rollouts(self, count: int) -> Rollouts | None:
        """Return the plan's `count` sampled rollouts of largest weight; None without a plan in force.

        A look from outside: no later tick is changed by it.
        """
        return None if self._plan is None else self._planner.sampled_rollouts(count)

    def screen(self, readings: Readings) -> Readings:
        """Leave out the headings that are no measurement; to be called once for the readings of each step."""
        if not readings.poses:
            return readings
        geometry, difference_rad = self.fusion.parameters, self.fusion.wheel_difference_rad
        turn_per_rad = geometry.wheel_radius_m / geometry.axial_distance_m
        poses = []
        for sample in readings.poses:
            pose, never_measured = self.headings.screen(sample, difference_rad, turn_per_rad)
            poses.append(pose)
            if never_measured:
                self.fusion.reset_heading()
        return msgspec.structs.replace(readings, poses=tuple(poses))

    def step(
        self,
        now_ns: int,
        readings: Readings,
        motion: Motion,
        mark: Callable[[str], None] = untimed,
        fence_overridden: bool = False,
    ) -> Tick:
        """Advance by one tick; `mark(stage)` is called at the end of the stages "estimate" and "plan".

        `fence_overridden`: a person drives in spite of the fence. Never raises on what the robot sent; a planner
        without a valid control is reported in the tick.
        """
        for wheels in readings.wheels:
            self.fusion.add_wheels(wheels)
        updates = tuple(self.fusion.add_pose(pose, now_ns) for pose in readings.poses)
        self.fusion.sources.step(now_ns)
        estimate = self.fusion.estimate(now_ns)
        if self._means is not None and self._last_ns is not None:
            between_s = (now_ns - self._last_ns) * 1e-9
            self._means.add_wheels(estimate.left_speed_rad_s, estimate.right_speed_rad_s, between_s)
        mark("estimate")
        plan, failure = None, None
        if isinstance(motion, FollowTask):
            plan, failure = self._replan(now_ns, estimate)
        else:
            self._plan, self._following = None, False
        source, requested = self._desired(now_ns, motion, plan)
        fence, allowed = self._guarded(estimate, source, requested, fence_overridden)
        command = self._govern(now_ns, source, allowed)
        if allowed is not requested:
            command = msgspec.structs.replace(command, limited=command.limited | Limited.FENCE)
        mark("plan")
        return Tick(
            t_ns=now_ns,
            pose_updates=updates,
            estimate=estimate,
            plan=plan,
            planner_failure=failure,
            source=source,
            requested=requested,
            command=command,
            fence=fence,
        )

    def _guarded(
        self, estimate: PoseEstimate, source: Source, requested: tuple[float, float], overridden: bool
    ) -> tuple[FenceState, tuple[float, float]]:
        """Return the fence guard's verdict on the requested wheel speeds, and the speeds (rad/s) that it allows."""
        if source in {Source.OFF, Source.SILENT}:
            return IDLE, requested
        last = (self._sent[-1].left_rad_s, self._sent[-1].right_rad_s) if self._sent else (0.0, 0.0)
        found = self.guard.step(estimate, self.fusion.parameters, last, requested, overridden)
        if found.verdict in STOPS_MOTION:
            return found, (0.0, 0.0) if requested != (0.0, 0.0) else requested
        if found.scale == 1.0:
            return found, requested
        return found, (found.scale * requested[0], found.scale * requested[1])

    def _replan(self, now_ns: int, estimate: PoseEstimate) -> tuple[WheelPlan | None, str | None]:
        if not self._following:
            self._planner.reset()
            self._following = True
        state = PlannerState(
            t_ns=now_ns,
            x_m=estimate.x_m,
            y_m=estimate.y_m,
            yaw_rad=estimate.yaw_rad,
            left_speed_rad_s=estimate.left_speed_rad_s,
            right_speed_rad_s=estimate.right_speed_rad_s,
            sent=tuple(self._sent),
            drift=self._drift,
            lateral_lag_s=self._lateral_lag_s,
            command_means=() if self._means is None else self._means.commands,
            body_means=() if self._means is None else self._means.body,
        )
        if self._avoids is not None:
            self._avoids.look_around(self.guard.boundaries, corner_deviation_m(estimate, self.guard.boundaries))
        try:
            plan = self._planner.plan(now_ns, state)
        except NoValidControl as error:
            return None, str(error)
        self._plan, self._plan_made_ns = plan, now_ns
        return plan, None

    def _desired(self, now_ns: int, motion: Motion, new: WheelPlan | None) -> tuple[Source, tuple[float, float]]:
        match motion:
            case Off():
                return Source.OFF, (0.0, 0.0)
            case Standstill():
                return Source.HOLD, (0.0, 0.0)
            case Silent():
                return Source.SILENT, (0.0, 0.0)
            case Manual(left_rad_s=left, right_rad_s=right):
                return Source.MANUAL, (left, right)
            case FollowTask():
                if self._plan is None or now_ns - self._plan_made_ns > self._plan_tail_ns:
                    return Source.RAMP, (0.0, 0.0)
                steered = self._plan.diagnostics.outcome is PlanOutcome.FALLBACK
                source = Source.TAIL if new is None else Source.FALLBACK if steered else Source.PLAN
                return source, self._plan.at(now_ns)

    def _govern(self, now_ns: int, source: Source, requested: tuple[float, float]) -> Governed:
        if source in {Source.OFF, Source.SILENT}:
            self._governor.reset()
        dt_s = 0.0 if self._last_ns is None else (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        command = self._governor.step(requested[0], requested[1], dt_s)
        self._sent.append(SentCommand(now_ns, command.left_rad_s, command.right_rad_s))
        while now_ns - self._sent[0].t_ns > HISTORY_NS:
            gone = self._sent.popleft()
            if self._means is not None:
                self._means.add_command(gone.left_rad_s, gone.right_rad_s, (self._sent[0].t_ns - gone.t_ns) * 1e-9)
        return command
