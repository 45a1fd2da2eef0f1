"""What a planner takes and gives: the state and the commands before it, and a plan as a function of time.

A control law of your own (`Law`: a function from the robot's state to wheel speeds) is a planner as `LawController`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.model import Belief, Model
from disco_hw.model.coefficients import NO_DISTURBANCE, Disturbance

Array = NDArray[np.float64]


class NoValidControl(Exception):  # noqa: N818
    """No command sequence with a finite cost was found, after every retry; the message says what was tried."""


class SentCommand(msgspec.Struct, frozen=True, gc=False):
    """Wheel speeds (rad/s) commanded from `t_ns` on."""

    t_ns: int
    left_rad_s: float
    right_rad_s: float


class PlannerState(msgspec.Struct, frozen=True, gc=False):
    """Pose in the world frame and measured wheel speeds at `t_ns`, and the commands sent up to now, oldest first.

    `disturbance`: how the robot moves beside its model.
    `elapsed_s`: time since the drive began, for effects that depend on it; None counts from the planner's start.
    """

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    left_speed_rad_s: float
    right_speed_rad_s: float
    sent: tuple[SentCommand, ...] = ()
    elapsed_s: float | None = None
    disturbance: Disturbance = NO_DISTURBANCE


class PlanOutcome(enum.Enum):
    """How a plan came about: at once, after a retry, from scratch, or, because nothing helped, as a ramp to zero or
    from a classical follower."""

    PLANNED = "planned"
    RETRIED = "retried"
    RESTARTED = "restarted"
    STOPPING = "stopping"
    FALLBACK = "fallback"


class Diagnostics(msgspec.Struct, frozen=True):
    """How the optimisation went.

    `ess` effective sample size, `collapsed` whether it is below the alarm; `temperature`; `cost_min`, `cost_mean` of
    the samples and `cost_nominal` of sample 0, which is the plan that they vary; `valid_samples` with a finite cost;
    `retries` made and the `outcome`.
    """

    ess: float
    temperature: float
    cost_min: float
    cost_mean: float
    cost_nominal: float
    valid_samples: int
    retries: int = 0
    collapsed: bool = False
    outcome: PlanOutcome = PlanOutcome.PLANNED


class WheelPlan(msgspec.Struct, frozen=True, eq=False):
    """Wheel speeds from `t0_ns` on, as a function of time.

    `wheel_speeds` (T, 2) rad/s, left and right: the mean over each step of `step_s`. `trajectory` (T + 1, 3): the pose
    x, y, yaw that the model predicts at the steps' ends, from the pose at `t0_ns`.
    """

    t0_ns: int
    step_s: float
    wheel_speeds: Array
    trajectory: Array
    diagnostics: Diagnostics

    def at(self, t_ns: int) -> tuple[float, float]:
        """Wheel speeds (left, right) at a time: linear between the middles of the steps, constant beyond the ends."""
        position = (t_ns - self.t0_ns) * 1e-9 / self.step_s - 0.5
        last = len(self.wheel_speeds) - 1
        index = min(max(int(position), 0), last - 1)
        fraction = min(max(position - index, 0.0), 1.0)
        (left, right), (left_next, right_next) = self.wheel_speeds[index : index + 2].tolist()
        return left + fraction * (left_next - left), right + fraction * (right_next - right)

    def age_s(self, now_ns: int) -> float:
        """Seconds since the plan's start; negative before it."""
        return (now_ns - self.t0_ns) * 1e-9

    def expired(self, now_ns: int) -> bool:
        """Whether the plan's horizon is over."""
        return bool(self.age_s(now_ns) > self.step_s * len(self.wheel_speeds))


@dataclass(frozen=True, eq=False, slots=True)
class Rollouts:
    """Some of the sequences that the last plan was made from.

    `wheel_speeds` (n, T, 2) rad/s, `trajectories` (n, T + 1, 3) x, y, yaw, `weights` (n,) of all that sum to one.
    """

    wheel_speeds: Array
    trajectories: Array
    weights: Array


def command_history(
    sent: Sequence[SentCommand], end_ns: int, step_s: float, count: int, otherwise: tuple[float, float]
) -> NDArray[np.float64]:
    """Mean commands (count, 2) over the `count` steps that end at `end_ns`, oldest first.

    `sent` is oldest first; a command holds until the next one. What was before the first one counts as equal to it, and
    without any command all are `otherwise`.
    """
    means = np.empty((count, 2))
    if not sent:
        means[:] = otherwise
        return means
    step_ns = step_s * 1e9
    index = len(sent) - 1
    for row in range(count - 1, -1, -1):
        until = end_ns - (count - 1 - row) * step_ns
        since = until - step_ns
        left = right = 0.0
        upper = until
        while upper > since:
            while index > 0 and sent[index].t_ns >= upper:
                index -= 1
            command = sent[index]
            lower = since if index == 0 else max(since, float(command.t_ns))
            left += command.left_rad_s * (upper - lower)
            right += command.right_rad_s * (upper - lower)
            upper = lower
        means[row] = left / step_ns, right / step_ns
    return means


Law = Callable[[PlannerState, Any, Model], tuple[float, float]]
"""State, task ([task] of robot.toml) and model to wheel speeds, left and right (rad/s); asked once a control period."""

HELD_STEPS, _STEP_S = 4, 0.1


class LawController:
    """A planner that holds what a law says until it is asked again, one control period later.

    A law that raises NoValidControl, or whose answer is not two finite numbers, has no plan: the last one is followed
    for `control.plan_tail_s`, then the wheels ramp to zero. Any other exception ends the daemon, which stops the robot.
    The law's `reset()`, where it has one, is called before each start.
    """

    def __init__(self, law: Law, model: Model, task: Any) -> None:
        self._law, self._model, self._task = law, model, task

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Ask the law; raises NoValidControl."""
        asked = self._law(state, self._task, self._model)
        try:
            left, right = (float(speed) for speed in asked)
        except (TypeError, ValueError):
            left = right = math.nan
        if not (math.isfinite(left) and math.isfinite(right)):
            raise NoValidControl(f"the control law gave {asked!r}; it has to give two finite wheel speeds, rad/s")
        return held_plan(now_ns, state, left, right, self._model.point()[:3])

    def reset(self) -> None:
        """Hand on that a drive begins."""
        reset = getattr(self._law, "reset", None)
        if reset is not None:
            reset()

    def set_task(self, task: Any) -> None:
        """Hand another task to the law from the next plan on."""
        self._task = task

    def set_belief(self, _belief: Belief) -> None:
        """Nothing: a law keeps the model that it was given."""

    def sampled_rollouts(self, _count: int) -> Rollouts:
        """None are sampled."""
        return no_rollouts()


def held_plan(now_ns: int, state: PlannerState, left_rad_s: float, right_rad_s: float, base: Any) -> WheelPlan:
    """These wheel speeds for 0.4 s, and where a robot of this base (wheel radius, axial distance, x_icr; m) goes."""
    wheel_radius_m, axial_distance_m, x_icr_m = base
    forward = 0.5 * wheel_radius_m * (left_rad_s + right_rad_s)
    turn = wheel_radius_m * (right_rad_s - left_rad_s) / axial_distance_m
    yaw = state.yaw_rad + turn * _STEP_S * np.arange(HELD_STEPS + 1)
    x_step = _STEP_S * (forward * np.cos(yaw) + turn * x_icr_m * np.sin(yaw))
    y_step = _STEP_S * (forward * np.sin(yaw) - turn * x_icr_m * np.cos(yaw))
    x, y = (np.concatenate([[0.0], np.cumsum(step[:-1])]) for step in (x_step, y_step))
    trajectory = np.column_stack([state.x_m + x, state.y_m + y, yaw])
    nothing = Diagnostics(1.0, 0.0, 0.0, 0.0, 0.0, 1, outcome=PlanOutcome.PLANNED)
    return WheelPlan(now_ns, _STEP_S, np.tile([left_rad_s, right_rad_s], (HELD_STEPS, 1)), trajectory, nothing)


def no_rollouts() -> Rollouts:
    """For a planner that samples nothing."""
    return Rollouts(np.empty((0, HELD_STEPS, 2)), np.empty((0, HELD_STEPS + 1, 3)), np.empty(0))
