"""Stochastic model predictive control (DISCO) with rollouts of every command sequence under the belief."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from disco_hw.control.kernel import BLOCK, CHANNELS, WHEEL_ROWS, aligned_zeros
from disco_hw.control.kernel.avoid import Area
from disco_hw.control.kernel.guide import SteeredChassis, guide
from disco_hw.control.kernel.skid_steer import SkidSteer
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.parameter_points import (
    drawn_points,
    equivalent_points,
    mean_point,
    point_estimate,
    shared_pairs,
    unscented_points,
)
from disco_hw.control.past_motion import PastMotion
from disco_hw.control.plan import (
    Array,
    CommandLimits,
    Diagnostics,
    DiscoSettings,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Rollouts,
    WheelPlan,
    command_history,
)
from disco_hw.control.refinement import STEP_S as REFINED_STEP_S
from disco_hw.control.refinement import Refinement, RefinementStart
from disco_hw.control.surroundings import Surroundings
from disco_hw.control.wheel_loss import WheelLoss
from disco_hw.effects import Channel
from disco_hw.effects.registry import DELAY
from disco_hw.fence.clearance import Boundaries
from disco_hw.jit import compiled_for
from disco_hw.model import Belief, Model
from disco_hw.model.coefficients import NO_DISTURBANCE, NO_SLIDE
from disco_hw.model.model import BASE_PARAMETERS, X_ICR, coefficient_tables
from disco_hw.model.step import FreeRun, integration_series
from disco_hw.tasks import PlannedTask

NARROW_TURN_RAD = 0.4
DELAYED_BY = DELAY.columns[0]
# A plan stands that in its first half gets nowhere further away than this part of the way that it is to go.
NOWHERE = 0.25
# Steps kept beyond the longest delay that is believed in at first, for later beliefs.
SPARE_HISTORY = 2
SHORTEST_GAP_S = 1e-6
# A plan goes by no more than this faster than the task asks, or than the robot goes.
SPEED_TO_SPARE = 1.25
# Outcomes whose plan is refined.
REFINED = (PlanOutcome.PLANNED, PlanOutcome.RETRIED)


class Disco:
    """Plans wheel speeds for a task.

    Pure: no clock, no thread, and the same seed, calls and states give the same plans bit for bit. The first call
    compiles; `warm_up` does that beforehand.
    """

    def __init__(
        self, model: Model, task: PlannedTask, settings: DiscoSettings, limits: CommandLimits, seed: int = 1,
        surroundings: Surroundings | None = None,
    ) -> None:  # fmt: skip
        sampler, step_s = settings.sampler, settings.step_s
        self._model, self._task, self._settings, self._limits, self._seed = model, task, settings, limits, seed
        self._own_draws = settings.uncertainty == "joint" or (
            settings.uncertainty == "mc" and not settings.common_draws
        )
        theta, weights = self._shared_points(model)
        self._weights = weights.astype(np.float32)
        self._skip_mean_cost = True if self._weights[0] == 0.0 and not self._own_draws else None
        delay_is_believed = model.belief is not None and DELAYED_BY in model.belief.names
        self._history = self._history_for(model, theta) + (SPARE_HISTORY if delay_is_believed else 0)
        may_turn_more = settings.uncertainty in ("mc", "joint") or any(s.effect.may_turn_more for s in model.effects)
        self._wide = True if may_turn_more or self._largest_turn_rad(theta) > NARROW_TURN_RAD else None
        self._series = integration_series(step_s, self._wide is not None, np.float32)
        self._euler = True if settings.euler else None
        # The axle's path under Euler steps depends on x_icr.
        self._pairs = 0 if settings.euler else shared_pairs(model, theta, step_s)
        self._refinement = Refinement(limits) if settings.refine else None
        self._take_points(model, theta)
        self._start = np.zeros(11, np.float32)
        self._slides = True if settings.offset_free else None
        self._loss = WheelLoss()
        self._disturbance, self._slide = NO_DISTURBANCE, NO_SLIDE
        # Whether wheels turn as the model says, and the robot with them.
        self._turns_as_asked = True
        self._wheels = aligned_zeros(sampler.horizon * WHEEL_ROWS * int(BLOCK))
        self._optimiser = Optimiser(
            sampler,
            CHANNELS,
            weights.size,
            self._history,
            limits.speed_rad_s,
            limits.acceleration_rad_s2 * step_s,
            seed,
        )
        self._surroundings = surroundings
        self._guide: Callable[..., None] | None = None
        self._guided_until_ns: int | None = None
        self._begun_ns: int | None = None
        self._t0_ns: int | None = None
        self._failing_since_ns: int | None = None
        self._memory: float | None = None
        self._planned_from, self._elapsed_s, self._earlier = (
            np.zeros(5),
            0.0,
            np.zeros((self._history, CHANNELS)),
        )
        # What is remembered where the plan begins, in the mean of what is believed, (n,), and under each point, (L, n).
        self._mean_means: Array | None = None
        self._means: Array | None = None

    def _shared_points(self, model: Model) -> tuple[Array, Array]:
        """Parameter points (L, P) and weights (L,) of the first step; those of `ut` and `point` stay."""
        settings = self._settings
        match settings.uncertainty:
            case "ut":
                return unscented_points(model, settings.ut_alpha)
            case "point":
                return point_estimate(model)
            case "mc":
                count = settings.draws
            case "joint":
                count = 1
        return drawn_points(model, count, self._seed, 0), np.full(count, 1.0 / count)

    def _take_points(self, model: Model, theta: Array) -> None:
        """Plan under the points (L, P) of a model from now on."""
        step_s = self._settings.step_s
        self._model = model
        self._mean_theta = mean_point(model)
        self._mean = FreeRun(model, self._mean_theta, step_s)
        self._wheel_runs: dict[int, FreeRun] = {}
        self._x_icr_m = float(self._mean_theta[0, model.parameter_names.index(X_ICR.name)])
        self._points = FreeRun(model, theta, step_s)
        late = [f"{s.name}.{s.effect.late_by}" for s in model.effects if s.effect.late_by is not None]
        dead = [f"{s.name}.{s.effect.dead_by}" for s in model.effects if s.effect.dead_by is not None]
        self._response_s = sum(self._value(self._mean_theta, name) for name in late)
        dead_rad_s = sum(self._value(self._mean_theta, name) for name in dead)
        radius_m, axle_m = (self._value(self._mean_theta, one.name) for one in BASE_PARAMETERS if one is not X_ICR)
        self._chassis = SteeredChassis(radius_m, axle_m, self._x_icr_m, float(self._response_s), float(dead_rad_s))
        self._tables = coefficient_tables(model, theta, step_s, np.float32)
        found = equivalent_points(model, theta, step_s, self._pairs)
        self._ahead, self._scaled = (
            np.ascontiguousarray(found[:, 2 * pair : 2 * pair + 2]) if pair < self._pairs else None for pair in (0, 1)
        )
        self._wheels_differ = self._do_wheels_differ(theta)
        self._past = PastMotion.of(model, theta, self._mean_theta)
        if self._refinement is not None:
            shared = self._settings.uncertainty == "ut"
            self._refinement.take_points(
                model,
                theta if shared else self._mean_theta,
                self._weights.astype(np.float64) if shared else np.ones(1),
                self._chassis,
            )

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief from the next `plan` on; the last plan and the random numbers go on.

        Nothing is compiled and no buffer changes its size: takes a fraction of a millisecond. A run repeats bit for bit
        if the same beliefs are set before the same plans. Raises ValueError, and keeps the old belief, unless it is
        over the parameters of the first one, finite, and within what the buffers were laid out for: much longer command
        delays or faster turns than at first are refused.
        """
        old = self._model.belief
        names = None if old is None else old.names
        if names is None or set(belief.names) != set(names):
            raise ValueError(f"belief over {belief.names}, but the planner was laid out for one over {names}")
        model = replace(self._model, belief=belief)
        theta, weights = self._shared_points(model)
        if not np.isfinite(theta).all() or weights.size != self._weights.size:
            raise ValueError("the belief's points are not finite, or not as many as before")
        if self._history_for(model, theta) > self._history:
            raise ValueError(f"{DELAYED_BY}: longer than the {self._history} steps of commands that the planner keeps")
        if self._wide is None and self._largest_turn_rad(theta) > NARROW_TURN_RAD:
            raise ValueError(f"the wheels would turn the robot by more than {NARROW_TURN_RAD} rad in a step")
        self._take_points(model, theta)

    def _largest_turn_rad(self, theta: Array) -> float:
        """Largest turn in a step under the points (L, P)."""
        ratio = float((theta[:, 0] / theta[:, 1]).max())
        return 2.0 * self._limits.speed_rad_s * self._settings.step_s * ratio

    def _history_for(self, model: Model, theta: Array) -> int:
        """Return the number of past commands that the points (L, P) and the mean look back on."""
        delay_steps = max(self._value(each, DELAYED_BY) for each in (theta, mean_point(model))) / self._settings.step_s
        return 0 if delay_steps == 0.0 else math.floor(delay_steps) + 1

    def _value(self, theta: Array, name: str) -> float:
        """Largest value of a parameter in points (L, P); 0 if the model does not have it."""
        names = self._model.parameter_names
        return float(theta[:, names.index(name)].max()) if name in names else 0.0

    def _do_wheels_differ(self, theta: Array) -> bool:
        """Whether the points (L, P) differ in a parameter between command and wheel."""
        differing = {name for name, column in zip(self._model.parameter_names, theta.T, strict=True) if np.ptp(column)}
        wheel_effects = [s for s in self._model.effects if s.effect.channel is Channel.COMMAND_TO_WHEEL]
        names = {f"{setting.name}.{key}" for setting in wheel_effects for key in setting.values}
        if any(setting.effect.uses_geometry for setting in wheel_effects):
            names |= {parameter.name for parameter in BASE_PARAMETERS}
        return bool(names & differing)

    @property
    def task(self) -> PlannedTask:
        """The task that is planned for."""
        return self._task

    @property
    def chassis(self) -> SteeredChassis:
        """The robot in the mean of what is believed."""
        return self._chassis

    @property
    def settings(self) -> DiscoSettings:
        """The settings that plans are made with."""
        return self._settings

    def set_task(self, task: PlannedTask) -> None:
        """Plan for another task of the same type from the next `plan` on; nothing is compiled. Raises TypeError."""
        if type(task) is not type(self._task):
            raise TypeError(f"the planner was compiled for {type(self._task).__name__}, not {type(task).__name__}")
        self._task = task
        self.reset()

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

    @property
    def optimiser(self) -> Optimiser:
        """The sampling optimiser, for its buffers and figures."""
        return self._optimiser

    @property
    def refinement(self) -> Refinement | None:
        """The refinement of plans beside the line; None where the settings have none."""
        return self._refinement

    def reset(self) -> None:
        """Forget the last plan, as at a new start; the random numbers go on."""
        self._optimiser.reset()
        self._begun_ns = self._t0_ns = self._failing_since_ns = self._memory = self._guided_until_ns = None
        self._loss.pause()
        if self._refinement is not None:
            self._refinement.reset()

    def warm_up(self) -> None:
        """Compile everything that any method calls, or load it from disk; leaves the planner as after `reset`."""
        number = self._optimiser.step_number
        self.reset()
        self.plan(0, PlannerState(0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self.sampled_rollouts(1)
        self.point_trajectories()
        self._optimiser.step_number = number
        self.reset()

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Plan from the state, predicted to when a command made from it acts.

        A step without a valid result is tried again, then planned anew from standstill, then answered with a ramp to
        zero for `decay_s`; after that NoValidControl is raised. Plans and commands are finite in any case.
        """
        settings = self._settings
        t0_ns = now_ns + round(settings.latency_s * 1e9)
        self._follow_disturbance(now_ns, state)
        before = self._anchor(state)
        first = self._t0_ns is None
        begun_ns = now_ns if self._begun_ns is None else self._begun_ns
        self._begun_ns = begun_ns
        elapsed_s = (t0_ns - begun_ns) * 1e-9 if state.elapsed_s is None else state.elapsed_s + settings.latency_s
        start = self._predicted(state, t0_ns, elapsed_s)
        if self._past is not None and self._mean_means is not None:
            self._means = self._past.of_points(state, t0_ns, self._acting, self._mean_means)
        system = self._system(state, start, t0_ns, (t0_ns - begun_ns) * 1e-9, elapsed_s)
        shift_steps = 0.0 if self._t0_ns is None else (t0_ns - self._t0_ns) * 1e-9 / settings.step_s
        self._t0_ns = t0_ns
        guided = self._draw_guide(system, before)
        outcome, retries = self._improve(max(shift_steps, 0.0), before, system, first, guided)
        if outcome is not PlanOutcome.STOPPING and self.is_trapped:
            outcome = PlanOutcome.STOPPING
        if outcome is PlanOutcome.STOPPING:
            self._stop(now_ns, before)
        else:
            self._failing_since_ns = None
            self._leave_touching_plan()
        self._planned_from, self._elapsed_s = start, elapsed_s
        nominal = self._optimiser.nominal()
        trajectory = self._mean_trajectory(nominal)
        refined = None
        if self._refinement is not None and outcome in REFINED:
            refined = self._refined(state, system, start, t0_ns, elapsed_s, before, nominal)
        if guided and self._is_to_be_guided(now_ns, system, trajectory):
            self._optimiser.take_guide()
            nominal = self._optimiser.nominal()
            trajectory = self._mean_trajectory(nominal)
        elif refined is not None:
            return WheelPlan(t0_ns, REFINED_STEP_S, *refined, self._diagnostics(retries, outcome))
        return WheelPlan(
            t0_ns=t0_ns,
            step_s=settings.step_s,
            wheel_speeds=self._asked(nominal),
            trajectory=trajectory,
            diagnostics=self._diagnostics(retries, outcome),
        )

    def _refined(
        self, state: PlannerState, system: SkidSteer, start: Array, t0_ns: int, elapsed_s: float,
        before: tuple[float, float], nominal: Array,
    ) -> tuple[Array, Array] | None:  # fmt: skip
        """Return the refined commands (N, 2), as the robot is to get them, and where they lead; None without such."""
        refinement = self._refinement
        assert refinement is not None
        wheels = state.left_speed_rad_s, state.right_speed_rad_s
        past = self._acting(command_history(state.sent, t0_ns, REFINED_STEP_S, refinement.history, wheels))
        means = None
        if self._mean_means is not None:
            means = self._mean_means[None] if self._settings.uncertainty != "ut" else self._means
        initial = RefinementStart(system.task, system.start, start, elapsed_s, self._slide, means, past, before)
        commands = refinement.improve(initial, t0_ns, nominal, self._settings.step_s)
        if commands is None:
            return None
        own = None if self._mean_means is None else self._mean_means.copy()
        past = np.concatenate([past, commands])
        states = refinement.mean.states(start, past, refinement.history, elapsed_s, 0, self._slide, own)
        path = states[:, :3]
        # The refinement knows the line and nothing else: near an obstacle or a fence the sampled plan stands.
        if self._surroundings is not None and not self._surroundings.allows(path):
            return None
        return self._asked(commands), path

    def _diagnostics(self, retries: int, outcome: PlanOutcome) -> Diagnostics:
        ess, temperature, least, mean, nominal, valid = self._optimiser.work.report.tolist()
        collapsed = ess < self._settings.min_ess
        return Diagnostics(ess, temperature, least, mean, nominal, int(valid), retries, collapsed, outcome)

    def _improve(
        self, shift_steps: float, before: tuple[float, float], system: SkidSteer, first: bool, guided: bool
    ) -> tuple[PlanOutcome, int]:
        """Climb the ladder until a step is valid; returns how it went and the attempts beyond the first."""
        settings, optimiser = self._settings, self._optimiser
        retries = 0
        gain = 1.0 if first or not settings.gain_by_time else min(shift_steps, 1.0)
        usable = optimiser.step(shift_steps, gain, before, system, self._weights)
        while retries < settings.retries and not (usable and optimiser.ess >= settings.min_ess):
            retries += 1
            usable = optimiser.step(0.0, gain, before, system, self._weights) or usable
        outcome = PlanOutcome.RETRIED if retries else PlanOutcome.PLANNED
        if not usable:
            optimiser.reset()
            outcome = PlanOutcome.RESTARTED
            retries += 1
            usable = optimiser.step(0.0, 1.0, before, system, self._weights)
        if not usable:
            return PlanOutcome.STOPPING, retries
        if guided and optimiser.guide_is_better(settings.guide_below):
            optimiser.take_guide()
        if first or outcome is PlanOutcome.RESTARTED:
            for _ in range(settings.iterations_at_start - 1):
                optimiser.step(0.0, 1.0, before, system, self._weights)
        return outcome, retries

    def _draw_guide(self, system: SkidSteer, before: tuple[float, float]) -> bool:
        """Set the guide for the next step; returns whether the task has a line to be guided along."""
        if self._settings.guide_below <= 0.0 or not hasattr(system.task, "way_ahead_m"):
            self._optimiser.sample_guide(False)
            return False
        optimiser = self._optimiser
        optimiser.sample_guide(True)
        commands, step_s = optimiser.work.guide, self._settings.step_s
        arguments = commands, system.task, system.start, self._chassis, *before, optimiser.limits, step_s
        if self._guide is None:
            self._guide = compiled_for(guide, *arguments)
        self._guide(*arguments)
        return True

    def _is_to_be_guided(self, now_ns: int, system: SkidSteer, trajectory: Array) -> bool:
        """Whether the guide has the robot: for a horizon from a plan on that stands, as across the line or far off it.

        Turning in from there costs more than standing for as long as is planned, or is put off from plan to plan.
        """
        if not self._optimiser.guide_is_valid or self._guide_touches():
            return False
        settings = self._settings
        horizon_s = settings.sampler.horizon * settings.step_s
        half = settings.sampler.horizon // 2
        way_m = system.task.way_ahead_m(half * settings.step_s)
        # From the last place on: that of a plan which does not stand is far enough.
        begin, *places = trajectory[: half + 1, :2].tolist()
        if all(math.dist(begin, place) < NOWHERE * way_m for place in reversed(places)):
            self._guided_until_ns = now_ns + round(horizon_s * 1e9)
        return self._guided_until_ns is not None and now_ns < self._guided_until_ns

    @property
    def is_trapped(self) -> bool:
        """Whether every sample of the last step touches the fence or an obstacle for most of the horizon."""
        around = self._surroundings
        return around is not None and self._optimiser.least_cost >= around.trapped_cost

    def _guide_touches(self) -> bool:
        around = self._surroundings
        return around is not None and self._optimiser.guide_cost >= around.touching_cost

    def _leave_touching_plan(self) -> None:
        """Continue from the best sample where the plan touches something and that sample does not.

        The mean of samples that pass an obstacle on both sides leads through it.
        """
        around, optimiser = self._surroundings, self._optimiser
        if around is None or optimiser.least_cost >= around.touching_cost:
            return
        if optimiser.nominal_cost >= around.touching_cost:
            commands, _ = optimiser.sampled_commands(1)
            if len(commands):
                optimiser.set_nominal(commands[0])

    def _stop(self, now_ns: int, before: tuple[float, float]) -> None:
        """Put a ramp to zero in the plan's place; raises NoValidControl when that has gone on for too long."""
        if self._failing_since_ns is None:
            self._failing_since_ns = now_ns
        if (now_ns - self._failing_since_ns) * 1e-9 >= self._settings.decay_s:
            self._optimiser.reset()
            if self.is_trapped:
                raise NoValidControl(
                    "no way past the fence or an obstacle was found, and the robot stops before it; clear the way, or "
                    "drive it away from there"
                )
            raise NoValidControl(
                f"no command sequence had a finite cost for {self._settings.decay_s} s, in spite of retries and a "
                "restart; check the pose, the wheel speeds and the model"
            )
        steps = np.arange(1, self._settings.sampler.horizon + 1)[:, None]
        change = self._limits.acceleration_rad_s2 * self._settings.step_s
        start = np.nan_to_num(np.clip(np.array(before), -self._limits.speed_rad_s, self._limits.speed_rad_s))
        size = np.maximum(np.abs(start) - np.minimum(change, np.abs(start)) * steps, 0.0)
        self._optimiser.set_nominal(np.sign(start) * size)

    def _anchor(self, state: PlannerState) -> tuple[float, float]:
        """Commands that the plan's first change is limited from.

        The last ones sent; but no further from the measured wheel speeds than the wheels could be behind them, so that
        a plan does not run away from wheels that are held back.
        """
        left, right = self._turning(state.left_speed_rad_s, state.right_speed_rad_s)
        if not state.sent:
            return left, right
        last = state.sent[-1]
        last_left, last_right = last.left_rad_s, last.right_rad_s
        if not self._turns_as_asked:
            last_left, last_right = self._acting(np.array([[last_left, last_right]]))[0].tolist()
        slack = self._limits.acceleration_rad_s2 * (self._settings.step_s + self._response_s)
        return min(max(last_left, left - slack), left + slack), min(max(last_right, right - slack), right + slack)

    def _predicted(self, state: PlannerState, t0_ns: int, elapsed_s: float) -> Array:
        """State (5,) at `t0_ns`: x, y, yaw, wheel speeds, under the mean parameters and the commands already sent."""
        wheels = state.left_speed_rad_s, state.right_speed_rad_s
        start = np.array([state.x_m, state.y_m, state.yaw_rad, *self._turning(*wheels)])
        if self._past is not None:
            self._mean_means = self._past.of_mean(state, state.t_ns, self._acting, self._turning(*wheels))
        gap_s = (t0_ns - state.t_ns) * 1e-9
        if gap_s < SHORTEST_GAP_S:
            return start
        count = math.ceil(gap_s / self._settings.step_s)
        run = FreeRun(self._model, self._mean_theta, gap_s / count)
        past = self._acting(command_history(state.sent, t0_ns, gap_s / count, run.past_rows + count, wheels))
        ahead_s = elapsed_s - gap_s
        return np.asarray(run.states(start, past, run.past_rows, ahead_s, 0, self._slide, self._mean_means)[-1])

    def _follow_disturbance(self, now_ns: int, state: PlannerState) -> None:
        """Plan with this disturbance, and with what the wheels have lost of their commands since the last plan."""
        if not self._settings.offset_free:
            return
        self._disturbance, self._slide = state.disturbance, state.disturbance.slides
        self._loss.step(now_ns, state, self._wheels_after)
        self._turns_as_asked = self._disturbance.is_none and self._loss.is_none

    def _wheels_after(self, wheels: tuple[float, float], gap_s: float, state: PlannerState) -> tuple[float, float]:
        """Wheel speeds (rad/s) that the model makes of these and what was sent over so long up to the state."""
        gap_ms = max(round(gap_s * 1e3), 1)
        run = self._wheel_runs.get(gap_ms)
        if run is None:
            run = self._wheel_runs[gap_ms] = FreeRun(self._model, self._mean_theta, gap_ms * 1e-3)
        sent = command_history(state.sent, state.t_ns, gap_ms * 1e-3, run.past_rows + 1, wheels)
        start = np.array([0.0, 0.0, 0.0, *wheels])
        begin_ns = state.t_ns - gap_ms * 1_000_000
        means = None if self._past is None else self._past.of_mean(state, begin_ns, self._loss.acting, wheels)
        left, right = run.states(start, self._loss.acting(sent), run.past_rows, means=means)[-1, 3:].tolist()
        return left, right

    def _turning(self, left_rad_s: float, right_rad_s: float) -> tuple[float, float]:
        """Wheel speeds of an undisturbed robot that turns as this one does with these."""
        if self._turns_as_asked:
            return left_rad_s, right_rad_s
        return self._disturbance.turning(left_rad_s, right_rad_s, self._chassis.axial_distance_m)

    def _acting(self, commands: Array) -> Array:
        """Commands (N, 2) to an undisturbed robot that turns as this one does with these."""
        if self._turns_as_asked:
            return commands
        acting = self._loss.acting(commands)
        return np.column_stack(self._disturbance.turning(acting[:, 0], acting[:, 1], self._chassis.axial_distance_m))

    def _asked(self, commands: Array) -> Array:
        """Return the inverse of `_acting`."""
        if self._turns_as_asked:
            return commands
        left, right = self._disturbance.asked(commands[:, 0], commands[:, 1], self._chassis.axial_distance_m)
        return self._loss.asked(np.column_stack([left, right]))

    def _system(self, state: PlannerState, start: Array, t0_ns: int, task_s: float, elapsed_s: float) -> SkidSteer:
        x, y, yaw, left, right = start.tolist()
        task, (origin_x, origin_y), begin, self._memory = self._task.prepare(
            task_s, x, y, yaw, self._memory, self._settings.step_s, self._settings.sampler.horizon,
            self._x_icr_m,
        )  # fmt: skip
        direction = (math.cos(yaw), math.sin(yaw)) if math.isfinite(yaw) else (math.nan, math.nan)
        found, step_s = self._disturbance, self._settings.step_s
        carried = found.drift_x_m_s * step_s, found.drift_y_m_s * step_s
        self._start[:] = (
            x - origin_x, y - origin_y, *direction, left, right, elapsed_s, begin, *carried, found.left,
        )  # fmt: skip
        if self._history:
            wheels = state.left_speed_rad_s, state.right_speed_rad_s
            self._earlier = self._acting(command_history(state.sent, t0_ns, step_s, self._history, wheels))
            self._optimiser.set_command_history(self._earlier)
        if self._settings.uncertainty in ("mc", "joint"):
            self._draw_points()
        base, effects = self._tables
        each = True if self._own_draws else None
        means = None if self._means is None else self._means.astype(np.float32)
        return SkidSteer(
            self._start, self._slides, means, base, effects, each, self._ahead, self._scaled, self._skip_mean_cost,
            self._series, self._wide, self._euler, task, self._history, self._wheels, self._wheels_differ,
            self._area(x, y, (origin_x, origin_y)),
        )  # fmt: skip

    def _area(self, x_m: float, y_m: float, origin_m: tuple[float, float]) -> Area | None:
        around = self._surroundings
        if around is None:
            return None
        turning = max(abs(float(self._start[4])), abs(float(self._start[5])))
        fastest = SPEED_TO_SPARE * max(around.speed_m_s, turning * self._chassis.wheel_radius_m)
        return around.place(x_m, y_m, origin_m, fastest)

    def _draw_points(self) -> None:
        """Fresh draws of the belief for this step."""
        optimiser, model = self._optimiser, self._model
        count = self._weights.size * (optimiser.padded_samples if self._own_draws else 1)
        theta = drawn_points(model, count, self._seed, optimiser.step_number)
        self._tables = coefficient_tables(model, theta, self._settings.step_s, np.float32)

    def _with_past(self, wheel_speeds: Array) -> Array:
        """Commands from before the plan, then the plan: (history + T, 2)."""
        return np.concatenate([self._earlier, wheel_speeds]) if self._history else wheel_speeds

    def sampled_rollouts(self, count: int = 50) -> Rollouts:
        """Return the last plan's `count` sequences of the largest weight, rolled out under the mean parameters.

        A look from outside: takes under a millisecond for 50, and changes no plan. Empty before the first plan and when
        the last one is a ramp to zero.
        """
        commands, weights = self._optimiser.sampled_commands(count)
        trajectories = np.empty((len(commands), self._settings.sampler.horizon + 1, 3))
        for row, one in enumerate(commands):
            trajectories[row] = self._mean_trajectory(one)
        return Rollouts(np.array([self._asked(one) for one in commands]), trajectories, weights)

    def point_trajectories(self) -> Array:
        """Return the last plan under each shared parameter point (or draw): (L, T + 1, 3) x, y, yaw.

        As cheap as `sampled_rollouts`, and changes no plan.
        """
        wheel_speeds = self._optimiser.nominal()
        count = self._weights.size
        return np.array([self._trajectory(self._points, wheel_speeds, self._means, point) for point in range(count)])

    def _mean_trajectory(self, wheel_speeds: Array) -> Array:
        means = None if self._mean_means is None else self._mean_means[None]
        return self._trajectory(self._mean, wheel_speeds, means, 0)

    def _trajectory(self, run: FreeRun, wheel_speeds: Array, means: Array | None, point: int) -> Array:
        commands, start = self._with_past(wheel_speeds), self._planned_from
        own = None if means is None else means[point].copy()
        return run.states(start, commands, self._history, self._elapsed_s, point, self._slide, own)[:, :3]
