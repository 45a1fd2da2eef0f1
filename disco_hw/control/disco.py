"""Stochastic model predictive control (DISCO) with rollouts of every command sequence under the belief.

`Disco.plan` reads as the paper's Algorithm 1; each of its parts is a file of its own:

    state ── StatePrediction ──▶ PlanStart
    belief ── RolloutPoints ─┬──▶ SkidSteer (the compiled rollout)
    task, Surroundings ──────┘        │
    Guidance ──▶ Sampling (on an Optimiser) ──▶ Refinement ──▶ WheelPlan
                     └── nothing valid ──▶ Stopping
"""

from __future__ import annotations

import math

import numpy as np

from disco_hw.control.backwards import Backwards
from disco_hw.control.kernel import BLOCK, CHANNELS, START_LEFT, START_RIGHT, START_SIZE, WHEEL_ROWS, aligned_zeros
from disco_hw.control.kernel.avoid import Area
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.kernel.skid_steer import SkidSteer
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.plan import (
    Array,
    CommandLimits,
    DiscoSettings,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Rollouts,
    WheelPlan,
)
from disco_hw.control.refinement import Refinement
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.sampling import Guidance, Sampling, Stopping
from disco_hw.control.state_prediction import PlanStart, StatePrediction
from disco_hw.control.surroundings import Surroundings, keeps_clear
from disco_hw.fence.clearance import Boundaries
from disco_hw.model import Belief, Model
from disco_hw.tasks import PlannedTask

SPEED_TO_SPARE = 1.25
"""A plan goes by no more than this faster than the task asks, or than the robot goes."""
REFINED = (PlanOutcome.PLANNED, PlanOutcome.RETRIED)
"""Outcomes whose plan is refined."""


class Disco:
    """Plans wheel speeds for a task.

    To look at: its `task`, `settings`, `optimiser` with its buffers and figures, and `refinement`, None without one.

    Pure: no clock, no thread, and the same seed, calls and states give the same plans bit for bit. The first call
    compiles; `warm_up` does that beforehand.
    """

    def __init__(
        self, model: Model, task: PlannedTask, settings: DiscoSettings, limits: CommandLimits, seed: int = 1,
        surroundings: Surroundings | None = None,
    ) -> None:  # fmt: skip
        self.task, self.settings, self._surroundings = task, settings, surroundings
        self._costed = self._as_driven(task)
        self._points = points = RolloutPoints(model, settings, limits, seed)
        self._limits = limits
        self._prediction = StatePrediction(points, settings, limits)
        sampler, change = settings.sampler, limits.acceleration_rad_s2 * settings.step_s
        self.optimiser = Optimiser(
            sampler, CHANNELS, points.weights.size, points.history, limits.speed_rad_s, change, seed
        )
        self._guidance = Guidance(self.optimiser, settings)
        self._sampling = Sampling(self.optimiser, points.weights, settings, surroundings)
        self.refinement = Refinement(limits, settings, points.history) if settings.refine else None
        self._set_refined_model()
        self._stopping = Stopping(settings, limits)
        # Buffers of the compiled rollout: where it begins, and how the wheels turn in it.
        self._start = np.zeros(START_SIZE, np.float32)
        self._wheels = aligned_zeros(sampler.horizon * WHEEL_ROWS * int(BLOCK))
        # Of the first plan since the last reset, and of the last one.
        self._begun_ns: int | None = None
        self._last_ns: int | None = None
        # What the task carries along from plan to plan.
        self._memory: float | None = None
        self._begin = PlanStart.at_rest(points.history)

    @property
    def chassis(self) -> SteeredChassis:
        """The robot in the mean of what is believed."""
        return self._points.chassis

    @property
    def is_trapped(self) -> bool:
        """Whether every sample of the last step touches the fence or an obstacle for most of the horizon."""
        return self._sampling.is_trapped

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief from the next `plan` on; the last plan and the random numbers go on.

        Nothing is compiled and no buffer changes its size: takes a fraction of a millisecond. A run repeats bit for bit
        if the same beliefs are set before the same plans. Raises ValueError, and keeps the old belief, unless it is
        over the parameters of the first one, finite, and within what the buffers were laid out for: much longer command
        delays or faster turns than at first are refused.
        """
        self._points.set_belief(belief)
        self._set_refined_model()

    def set_task(self, task: PlannedTask) -> None:
        """Plan for another task of the same type from the next `plan` on; nothing is compiled. Raises TypeError."""
        if type(task) is not type(self.task):
            raise TypeError(f"the planner was compiled for {type(self.task).__name__}, not {type(task).__name__}")
        self.task, self._costed = task, self._as_driven(task)
        self.reset()

    def _as_driven(self, task: PlannedTask) -> PlannedTask:
        """Return the task as its costs see the robot: as it is, or with its back as its front."""
        return Backwards(task) if self.settings.backwards else task

    def look_around(self, bounds: Boundaries, deviation_m: float) -> None:
        """Keep away from these boundaries from the next plan on; nothing without surroundings.

        `deviation_m`: standard deviation of the place of the footprint's corner that is known least.
        """
        if self._surroundings is not None:
            self._surroundings.look_around(bounds, deviation_m)

    def set_line(self, line_m: Array) -> None:
        """Drive around what stands on this line, points (N, 2); nothing without surroundings."""
        if self._surroundings is not None:
            self._surroundings.set_line(line_m)

    def reset(self) -> None:
        """Forget the last plan, as at a new start; the random numbers go on."""
        self._begun_ns = self._last_ns = self._memory = None
        self.optimiser.reset()
        self._guidance.reset()
        self._stopping.end()
        if self.refinement is not None:
            self.refinement.reset()

    def warm_up(self) -> None:
        """Compile everything that any method calls, or load it from disk; leaves the planner as after `reset`."""
        number = self.optimiser.step_number
        self.reset()
        self.plan(0, PlannerState(0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self.sampled_rollouts(1)
        self.point_trajectories()
        self.optimiser.step_number = number
        self.reset()

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Plan from the state, predicted to `now_ns`.

        A step without a valid result is tried again, then planned anew from standstill, then answered with a ramp to
        zero for `decay_s`; after that NoValidControl is raised. Plans and commands are finite in any case.
        """
        settings, optimiser, sampling = self.settings, self.optimiser, self._sampling
        # How long after the first plan and after the last one.
        begun_ns = self._begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        task_s, last_ns = (now_ns - begun_ns) * 1e-9, self._last_ns
        elapsed_s = task_s if state.elapsed_s is None else state.elapsed_s
        shift_steps = 0.0 if last_ns is None else max((now_ns - last_ns) * 1e-9 / settings.step_s, 0.0)

        # Where it begins, and what is rolled out from there.
        begin = self._prediction.start(state, now_ns, elapsed_s)
        system = self._system(begin, task_s)
        self._last_ns = now_ns

        # Sample around the last plan, roll out, weigh, update; stop where nothing helps.
        guided = self._guidance.offer(system, self.chassis, begin.before)
        outcome, retries = sampling.improve(shift_steps, begin.before, system, last_ns is None, guided)
        if sampling.is_trapped:
            outcome = PlanOutcome.STOPPING
        if outcome is PlanOutcome.STOPPING:
            self._stop(now_ns, begin)
        else:
            self._stopping.end()
            sampling.leave_touching_plan()
        self._begin = begin
        nominal = optimiser.nominal()

        # Beside the line the plan is refined; where it stands, the guide takes its place.
        refined = self._refined(begin, system, nominal) if outcome in REFINED else None
        diagnostics = sampling.diagnostics(outcome, retries, self._speed_part(outcome))
        trajectory = begin.mean_path(self._points.mean_run, nominal) if refined is None else refined[1]
        if guided and self._is_guided(now_ns, system, trajectory, refined is not None):
            optimiser.use_guide()
            nominal = optimiser.nominal()
            trajectory = begin.mean_path(self._points.mean_run, nominal)
        elif refined is not None:
            return WheelPlan(now_ns, settings.step_s, *refined, diagnostics)
        return WheelPlan(now_ns, settings.step_s, nominal, trajectory, diagnostics)

    def _system(self, begin: PlanStart, task_s: float) -> SkidSteer:
        """Return what the compiled step rolls out: f_theta from the plan's start, and the task's cost."""
        points, settings = self._points, self.settings
        x, y, yaw, left, right = begin.state.tolist()
        task, (origin_x, origin_y), place, self._memory = self._costed.prepare(
            task_s, x, y, yaw, self._memory, settings.step_s, settings.sampler.horizon, points.chassis.x_icr_m
        )
        direction = (math.cos(yaw), math.sin(yaw)) if math.isfinite(yaw) else (math.nan, math.nan)
        carried_m = begin.drift * settings.step_s
        self._start[:] = x - origin_x, y - origin_y, *direction, left, right, begin.elapsed_s, place, *carried_m
        if points.history:
            self.optimiser.set_command_history(begin.earlier)
        if points.is_sampled:
            points.draw(self.optimiser.step_number, self.optimiser.padded_samples)
        means = None if begin.point_means is None else begin.point_means.astype(np.float32)
        return SkidSteer(
            self._start, means, points.base, points.effects, points.each,
            points.ahead, points.scaled, points.skip_mean, points.series, points.wide, points.euler, task,
            points.history, self._wheels, points.wheels_differ, self._area(x, y, (origin_x, origin_y)),
        )  # fmt: skip

    def _area(self, x_m: float, y_m: float, origin_m: tuple[float, float]) -> Area | None:
        around = self._surroundings
        if around is None:
            return None
        turning = max(abs(float(self._start[START_LEFT])), abs(float(self._start[START_RIGHT])))
        fastest = SPEED_TO_SPARE * max(around.speed_m_s, turning * self.chassis.wheel_radius_m)
        return around.place(x_m, y_m, origin_m, fastest)

    def _stop(self, now_ns: int, begin: PlanStart) -> None:
        """Put a ramp to zero in the plan's place; raises NoValidControl when that has gone on for too long."""
        try:
            self.optimiser.set_nominal(self._stopping.ramp(now_ns, begin.before, self.is_trapped))
        except NoValidControl:
            self.optimiser.reset()
            raise

    def _is_guided(self, now_ns: int, system: SkidSteer, trajectory: Array, is_refined: bool) -> bool:
        """Whether the guide has the robot, whatever the plan costs."""
        if not self.optimiser.guide_is_valid or self._sampling.guide_touches:
            return False
        return self._guidance.has_robot(now_ns, system, self.chassis, trajectory, is_refined)

    def _set_refined_model(self) -> None:
        """Refine in the mean of the belief in force."""
        if self.refinement is not None:
            self.refinement.set_model(self._points.model, self._points.chassis)

    def _speed_part(self, outcome: PlanOutcome) -> float:
        """Return the part of the task's speed that the wheels can do ahead; 1 where no refinement was tried."""
        return 1.0 if self.refinement is None or outcome not in REFINED else self.refinement.speed_part

    def _refined(self, begin: PlanStart, system: SkidSteer, nominal: Array) -> tuple[Array, Array] | None:
        """Return the refined commands (N, 2) and where they lead; None without such."""
        if self.refinement is None:
            return None
        commands = self.refinement.improve(system.task, system.start, begin, nominal)
        if commands is None:
            return None
        # The refinement knows the line and nothing else: near an obstacle or a fence the sampled plan stands.
        around, limits, step_s = self._surroundings, self._limits, self.settings.step_s
        if around is not None and not keeps_clear(around, self._points, begin, commands, system.start, limits, step_s):
            return None
        return commands, begin.mean_path(self._points.mean_run, commands)

    def sampled_rollouts(self, count: int = 50) -> Rollouts:
        """Return the last plan's `count` sequences of the largest weight, rolled out under the mean parameters.

        A look from outside: takes under a millisecond for 50, and changes no plan. Empty before the first plan and when
        the last one is a ramp to zero.
        """
        commands, weights = self.optimiser.sampled_commands(count)
        trajectories = np.empty((len(commands), self.settings.sampler.horizon + 1, 3))
        for row, one in enumerate(commands):
            trajectories[row] = self._begin.mean_path(self._points.mean_run, one)
        return Rollouts(commands, trajectories, weights)

    def point_trajectories(self) -> Array:
        """Return the last plan under each shared parameter point (or draw): (L, T + 1, 3) x, y, yaw.

        As cheap as `sampled_rollouts`, and changes no plan.
        """
        points, nominal = self._points, self.optimiser.nominal()
        return np.array([self._begin.point_path(points.run, nominal, point) for point in range(points.weights.size)])
