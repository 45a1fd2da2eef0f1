"""Inputs and outputs of a planner: the settings of DISCO, the state and the commands before it, and a plan in time.

A control law of your own (`Law`: a function from the robot's state to wheel speeds) is a planner as `LawController`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw import config
from disco_hw.model import Belief, Model
from disco_hw.model.drift import NO_DRIFT, Drift

Array = NDArray[np.float64]
# Radians in a turn.
ROTATION = 2.0 * math.pi
PLANNER_VERSION, SAME_SINCE_VERSION, DISTURBANCE_UNTIL_VERSION = 10, 10, 5
"""Version of the plans that the default mode makes from the same input; a log names it, and a replay follows it.

1: the sampled plan, as `mode = "sampled"` has it now. 2: the plan is refined beside the line. 3: with other
weights, and shorter steps below 0.2 m/s. 4: along a line of way-points tabulated twice as finely. 5: against the ground
that carries the robot, where the log's beliefs say so. 6: with the lag of the body's sideways speed, where they say so,
another weight of the end, and tables of long paths as fine as those of short ones; `control.disturbance`, followed up
to `DISTURBANCE_UNTIL_VERSION`, does nothing. 7: from commands that the model says do not turn the wheels as fast, and
further ahead where the tracked point lies far behind the centre of rotation. 8: with a guide that ends its turns in
time and comes back from beyond a corner, and that takes no robot over while it brakes. 9: slower before what the
wheels' acceleration cannot follow, as a corner, and turned beyond a right angle to the line where the line asks for it.
10: above 0.9 m/s with longer steps, and refined also while the robot turns before a corner.
Logs since `SAME_SINCE_VERSION` are replayed alike.
"""
USUAL_SPEED_M_S, USUAL_STEP_S, USUAL_NOISE = 0.2, 0.1, 0.1 * ROTATION
# Chosen: longer steps of a slow robot would answer too late to what happens on the way. Refined plans gain by shorter
# ones: on a circle at 0.1 m/s six robots were 1.7 mm off with steps of 0.1 s, and 5.4 mm with 0.2 s (medians).
LONGEST_STEP_S, LONGEST_REFINED_STEP_S = 0.25, USUAL_STEP_S
# Above this speed (m/s) plans have steps of at least so many seconds, and a robot that turns so far (m) before a corner
# is refined meanwhile. Measured: in shorter steps a plan does not reach the end of a turn that the wheels' acceleration
# limits. Robots of Husky size at 1.2 and 1.6 m/s, wheels of 5 to 20 rad/s^2, swung to and fro by up to 1.7 m behind
# corners in 16 of 28 drives with steps of 0.04 s, in 2 with 0.08 s, and in none if they were refined in the turn. In 18
# others, at 1.0 and 1.4 m/s, they were up to 1.0 m off before, and 0.16 m now.
FAST_M_S, FAST_STEP_S, FAST_TURN_AHEAD_M = 0.9, 0.08, 0.04
# Noise of a fast robot grows with this power of its speed: with less it stays beside tight circles, with more it is
# pulled off them.
FASTER_NOISE = 0.2
# With the tracked point behind the centre of rotation an error of the heading grows e-fold over each x_icr of the way.
# A plan that covers fewer x_icr than the first number leaves it to grow, and covers as many as the second instead.
# Measured with refined plans, x_icr of 0.8 to 2 m, circles of 2 to 6 m: below 1.5 robots stayed up to 0.3 m off, with
# 2.5 some stood still, with 3.3 all but the largest were within 0.1 mm of the circle, with 4 all.
LEAST_WAY_X_ICR, WAY_X_ICR = 3.3, 4.0
USUAL_WIDE = 3.0

Uncertainty = Literal["ut", "mc", "joint", "point"]
Risk = Literal["mean", "cvar", "worst"]


def _require(holds: bool, field: str, hint: str) -> None:
    if not holds:
        raise ValueError(f"{field}: must be {hint}")


@dataclass(frozen=True, slots=True)
class CommandLimits:
    """Limits of a wheel command: speed (rad/s) and acceleration (rad/s^2)."""

    speed_rad_s: float
    acceleration_rad_s2: float = math.inf

    @classmethod
    def of_robot(cls, robot: config.Robot) -> CommandLimits:
        """Return the limits of robot.toml."""
        return cls(robot.max_wheel_speed_rad_s, robot.max_wheel_acceleration_rad_s2)


def ramp_to_zero(start: Array, limits: CommandLimits, step_s: float, steps: int) -> Array:
    """Return commands (steps, 2) from `start` (2,) to zero (rad/s), as fast as the acceleration limit allows."""
    change = limits.acceleration_rad_s2 * step_s
    size = np.maximum(np.abs(start) - np.minimum(change, np.abs(start)) * np.arange(1, steps + 1)[:, None], 0.0)
    ramp: Array = np.sign(start) * size
    return ramp


@dataclass(frozen=True, slots=True)
class Sampler:
    """Settings that say how command sequences are sampled, weighted and carried on, in the system's units.

    samples: sequences tried in a step (K). horizon: steps a plan covers (T).
    noise_std: standard deviation of the noise on one knot; of a fifth of the samples it is `wide` times as large, to
    find what lies further from the plan, as a turn on the spot does (compiled planners only).
    knots: cubic spline knots over the horizon, or None for white noise, one deviate a step.
    with_nominal: whether the plan itself is among the samples.
    temperature: of the softmax, or None to hold the effective sample size at `target_ess`.
    control_cost_weight: of the paper's term u' Sigma^-1 eps.
    update_from: the noise as `applied`, within the limits, or as `drawn`.
    beyond_end: what a shifted plan ends in: `hold` its last command or `zero`.
    risk: what is made of the costs under the parameter points: their `mean`, the mean of the worst `worst_part` of
    their weight (`cvar`), or the `worst`.
    """

    samples: int = 400
    horizon: int = 40
    noise_std: float = USUAL_NOISE
    wide: float = 1.0
    knots: int | None = 7
    with_nominal: bool = True
    temperature: float | None = None
    target_ess: float = 20.0
    control_cost_weight: float = 0.0
    update_from: Literal["applied", "drawn"] = "applied"
    beyond_end: Literal["hold", "zero"] = "hold"
    risk: Risk = "mean"
    worst_part: float = 0.25

    def __post_init__(self) -> None:
        _require(self.samples >= 2, "samples", "at least 2")
        _require(self.horizon >= 2, "horizon", "at least 2")
        _require(self.noise_std > 0.0, "noise_std", "above 0")
        _require(self.wide >= 1.0, "wide", "at least 1")
        _require(self.knots is None or self.knots >= 4, "knots", "at least 4, or None")
        _require(self.temperature is None or self.temperature > 0.0, "temperature", "above 0, or None")
        _require(self.target_ess >= 1.0, "target_ess", "at least 1")
        _require(self.control_cost_weight >= 0.0, "control_cost_weight", "0 or more")
        _require(0.0 < self.worst_part <= 1.0, "worst_part", "in (0, 1]")


@dataclass(frozen=True, slots=True)
class DiscoSettings:
    """Settings of the planner DISCO; the robot runs with the defaults.

    sampler: how sequences are sampled; its commands are wheel speeds in rad/s. step_s: length of a step.
    uncertainty: what every sequence is rolled out under: `ut` sigma points of the belief; `mc` `draws` of it, fresh
    ones in every step; `joint` one draw a sequence, so that weights are over pairs of sequence and parameters (the
    paper's control law); `point` the model's point values.
    common_draws: whether the draws of `mc` are shared by all sequences of a step (less noise in their order) or every
    sequence has its own, as in the paper's Algorithm 1.
    ut_alpha: spread of the sigma points; 1 keeps all weights non-negative.
    gain_by_time: whether a plan moves only the part shift / step_s towards the new optimum when it is made anew within
    a step. Then the plan changes as fast at any rate, and more plans a second average out noise instead of adding it.
    guide_below: where a steering law's commands cost less than this part of the plan, they take its place (tasks with
    a line; kernel/guide.py); for a horizon also where the plan stands, whatever they cost; 0 without a guide.
    euler: whether a step of a rollout goes straight along the heading that it begins with (explicit Euler), not along
    the exact arc.
    iterations_at_start: optimisation steps for the first plan after a reset.
    refine: whether a Gauss-Newton refinement in the mean of the belief improves the plan beside the task's line
    (refinement.py).
    turn_ahead_m: so far before a corner a robot that turns to where the line goes on counts as beside its line.
    backwards: whether the robot follows the task's line with its back ahead (backwards.py).
    min_ess: effective sample size below which a step counts as collapsed: it is tried again, and reported.
    retries: further attempts after a step without a valid result; then the plan is dropped and planned anew.
    decay_s: how long the planner answers with a ramp to zero when nothing helps, before it raises NoValidControl.
    """

    sampler: Sampler = Sampler(wide=USUAL_WIDE)
    step_s: float = USUAL_STEP_S
    uncertainty: Uncertainty = "ut"
    draws: int = 7
    common_draws: bool = True
    ut_alpha: float = 1.0
    gain_by_time: bool = True
    guide_below: float = 0.85
    euler: bool = False
    refine: bool = True
    turn_ahead_m: float = 0.0
    backwards: bool = False
    iterations_at_start: int = 5
    min_ess: float = 3.0
    retries: int = 2
    decay_s: float = 0.5

    def __post_init__(self) -> None:
        _require(self.step_s > 0.0, "step_s", "above 0")
        _require(self.draws >= 1, "draws", "at least 1")
        _require(self.ut_alpha > 0.0, "ut_alpha", "above 0")
        _require(self.iterations_at_start >= 1, "iterations_at_start", "at least 1")
        if self.uncertainty == "ut" and self.ut_alpha < 1.0 and self.sampler.risk != "mean":
            raise ValueError("ut_alpha: below 1 the weight of the mean is negative, so only risk 'mean' has a meaning")

    @classmethod
    def paper(cls) -> DiscoSettings:
        """Return the paper's skid-steer settings (appendix): white noise, control cost, UT with alpha = 0.5.

        K = 400, T = 50, temperature 0.1, control authority 0.25 (rotations per second)^2. Rollouts take Euler steps, as
        those of the skid-steer robot in the code of the same author do (github.com/lubaroli/dust).
        """
        temperature = 0.1
        sampler = Sampler(
            samples=400,
            horizon=50,
            noise_std=math.sqrt(0.25) * ROTATION,
            knots=None,
            with_nominal=False,
            temperature=temperature,
            control_cost_weight=temperature,
            update_from="drawn",
            beyond_end="zero",
        )
        return cls(
            sampler=sampler,
            common_draws=False,
            ut_alpha=0.5,
            gain_by_time=False,
            guide_below=0.0,
            euler=True,
            refine=False,
            iterations_at_start=1,
            min_ess=0.0,
        )

    @classmethod
    def for_speed(cls, speed_m_s: float, rate_hz: float, refine: bool = True) -> DiscoSettings:
        """Return the settings for a task of this speed (m/s) at `rate_hz` plans a second, with refinement or without.

        A slow robot plans over the same way as one at 0.2 m/s, with noise in proportion to its speed; a fast one has
        shorter steps, but no more than one a plan, and not below 0.08 s above 0.9 m/s. With these the mean
        distance from circles of 0.3 to 3 m stays below 2 mm with the true parameters (tests/control/test_no_offset.py).
        """
        slower = USUAL_SPEED_M_S / speed_m_s
        step_s = USUAL_STEP_S * (math.sqrt(slower) if slower < 1.0 else slower)
        step_s = max(min(step_s, LONGEST_STEP_S), 1.0 / rate_hz)
        noise_std = USUAL_NOISE * (slower**-FASTER_NOISE if slower < 1.0 else 1.0 / slower)
        sampler = Sampler(noise_std=noise_std, wide=USUAL_WIDE)
        is_fast = refine and speed_m_s > FAST_M_S
        if is_fast:
            step_s = max(step_s, FAST_STEP_S)
        if refine and step_s > LONGEST_REFINED_STEP_S:
            shorter_s = max(LONGEST_REFINED_STEP_S, 1.0 / rate_hz)
            sampler = replace(sampler, horizon=round(sampler.horizon * step_s / shorter_s))
            step_s = shorter_s
        ahead_m = FAST_TURN_AHEAD_M if is_fast else 0.0
        return cls(sampler=sampler, step_s=step_s, refine=refine, turn_ahead_m=ahead_m)

    @classmethod
    def from_config(cls, control: config.Control, speed_m_s: float, x_icr_m: float) -> DiscoSettings:
        """Return the settings that robot.toml asks for, for its task's speed and a robot of this x_icr."""
        if control.mode == "paper":
            settings = cls.paper()
        else:
            settings = cls.for_speed(speed_m_s, control.rate_hz, control.mode == "default")
        horizon, step_s = settings.sampler.horizon, settings.step_s
        if control.step_s is not None:
            # The number of steps that goes with steps of the task's speed says nothing of others.
            step_s, horizon = control.step_s, horizon if control.mode == "paper" else Sampler().horizon
        backwards = control.facing == "backwards"
        if control.mode != "paper":
            behind_m = -x_icr_m if backwards else x_icr_m
            if horizon * step_s * speed_m_s < LEAST_WAY_X_ICR * behind_m:
                horizon = min(math.ceil(WAY_X_ICR * behind_m / (speed_m_s * step_s)), config.LONGEST_HORIZON)
        horizon = horizon if control.horizon is None else control.horizon
        sampler = replace(settings.sampler, samples=control.samples, horizon=horizon)
        return replace(settings, sampler=sampler, step_s=step_s, uncertainty=control.uncertainty, backwards=backwards)


class NoValidControl(Exception):  # noqa: N818
    """No command sequence with a finite cost was found, after every retry; the message says what was tried."""


class SentCommand(msgspec.Struct, frozen=True, gc=False):
    """Wheel speeds (rad/s) commanded from `t_ns` on."""

    t_ns: int
    left_rad_s: float
    right_rad_s: float


class PlannerState(msgspec.Struct, frozen=True, gc=False):
    """Pose in the world frame and measured wheel speeds at `t_ns`, and the commands sent up to now, oldest first.

    `drift`: of the ground. `lateral_lag_s`: how long the body's sideways speed lags behind its turning.
    `command_means`, `body_means`: what the model's terms remember,
    of commands (a pair each) up to the first one of `sent`, of the wheels (a number each) up to `t_ns`; empty if
    nothing was before.
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
    drift: Drift = NO_DRIFT
    lateral_lag_s: float = 0.0
    command_means: tuple[tuple[float, float], ...] = ()
    body_means: tuple[float, ...] = ()


class PlanOutcome(enum.Enum):
    """Outcome of a planning step.

    Planned at once, after a retry, from scratch, or, because nothing helped, as a ramp to zero or from a classical
    follower.
    """

    PLANNED = "planned"
    RETRIED = "retried"
    RESTARTED = "restarted"
    STOPPING = "stopping"
    FALLBACK = "fallback"


class Diagnostics(msgspec.Struct, frozen=True):
    """Diagnostics of one optimisation.

    `ess` effective sample size, `collapsed` whether it is below the alarm; `temperature`; `cost_min`, `cost_mean` of
    the samples and `cost_nominal` of sample 0, which is the plan that they vary; `valid_samples` with a finite cost;
    `retries` made and the `outcome`; `speed_part`: the part of the task's speed that the wheels can do ahead, 1 where
    that is not known.
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
    speed_part: float = 1.0


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
    """Sampled sequences from which the last plan was made.

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

# Chosen: a plan of 0.4 s, with the same command throughout.
CONSTANT_STEPS, _STEP_S = 4, 0.1


class LawController:
    """A planner that holds what a law says until it is asked again, one control period later.

    A law that raises NoValidControl, or whose answer is not two finite numbers, has no plan: the last one is followed
    for `control.plan_tail_s`, then the wheels ramp to zero. Any other exception ends the daemon, which stops the robot.
    The law's `reset()`, where it has one, is called before each start.
    """

    def __init__(self, law: Law, model: Model, task: Any) -> None:
        self._law, self._model, self._task = law, model, task

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Return a plan that holds the law's wheel speeds; raise NoValidControl unless it gives two finite numbers."""
        desired = self._law(state, self._task, self._model)
        try:
            left, right = (float(speed) for speed in desired)
        except (TypeError, ValueError):
            left = right = math.nan
        if not (math.isfinite(left) and math.isfinite(right)):
            raise NoValidControl(f"the control law gave {desired!r}; it has to give two finite wheel speeds, rad/s")
        return constant_plan(now_ns, state, left, right, self._model.point()[:3])

    def reset(self) -> None:
        """Hand on that a drive begins."""
        reset = getattr(self._law, "reset", None)
        if reset is not None:
            reset()

    def set_task(self, task: Any) -> None:
        """Hand another task to the law from the next plan on."""
        self._task = task

    def set_belief(self, _belief: Belief) -> None:
        """Do nothing: a law keeps the model that it was given."""

    def sampled_rollouts(self, _count: int) -> Rollouts:
        """Return no rollouts: a law samples none."""
        return no_rollouts()


def constant_plan(now_ns: int, state: PlannerState, left_rad_s: float, right_rad_s: float, base: Any) -> WheelPlan:
    """Return a plan that holds these wheel speeds for 0.4 s on this base (wheel radius, axial distance, x_icr; m)."""
    wheel_radius_m, axial_distance_m, x_icr_m = base
    forward = 0.5 * wheel_radius_m * (left_rad_s + right_rad_s)
    turn = wheel_radius_m * (right_rad_s - left_rad_s) / axial_distance_m
    yaw = state.yaw_rad + turn * _STEP_S * np.arange(CONSTANT_STEPS + 1)
    x_step = _STEP_S * (forward * np.cos(yaw) + turn * x_icr_m * np.sin(yaw))
    y_step = _STEP_S * (forward * np.sin(yaw) - turn * x_icr_m * np.cos(yaw))
    x, y = (np.concatenate([[0.0], np.cumsum(step[:-1])]) for step in (x_step, y_step))
    trajectory = np.column_stack([state.x_m + x, state.y_m + y, yaw])
    nothing = Diagnostics(1.0, 0.0, 0.0, 0.0, 0.0, 1, outcome=PlanOutcome.PLANNED)
    return WheelPlan(now_ns, _STEP_S, np.tile([left_rad_s, right_rad_s], (CONSTANT_STEPS, 1)), trajectory, nothing)


def no_rollouts() -> Rollouts:
    """For a planner that samples nothing."""
    return Rollouts(np.empty((0, CONSTANT_STEPS, 2)), np.empty((0, CONSTANT_STEPS + 1, 3)), np.empty(0))
