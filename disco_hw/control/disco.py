"""DISCO: stochastic model predictive control that rolls out every command sequence under the belief over parameters."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.control.blocks import BLOCK, aligned_zeros, block_count
from disco_hw.control.parameter_points import parameter_points
from disco_hw.control.plan import Array, Diagnostics, NoValidControl, Plan, PlannerState
from disco_hw.control.replan import Sampling, Workspace, replan
from disco_hw.control.rollout import STATE_SIZE, Basis, Limits, Start
from disco_hw.control.settings import DiscoSettings, WheelLimits
from disco_hw.control.spline import spline_basis
from disco_hw.control.tasks.circle import Circle
from disco_hw.model import Model
from disco_hw.model.free_run import free_run
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import integration_of

NARROW_TURN_RAD = 0.4


class Disco:
    """Plans wheel speeds for a task. Pure: the same seed, calls and states give the same plans bit for bit."""

    def __init__(self, model: Model, task: Circle, settings: DiscoSettings, limits: WheelLimits, seed: int = 1) -> None:
        self._model = model
        self._task = task
        self._settings = settings
        self._limits = limits
        self._seed = seed
        self._step = 0
        self._t0_ns: int | None = None

        s, f32 = settings, np.float32
        theta, weights = parameter_points(model, s, seed)
        self._point_weights = weights.astype(f32)
        self._base, self._effects = coefficient_tables(model, theta, s.step_s, f32)
        mean = model.complete(weights[None] @ theta, model.parameter_names)
        self._mean_base, self._mean_effects = coefficient_tables(model, mean, s.step_s)
        turn = float(np.max(theta[:, 0] / theta[:, 1])) * 2.0 * limits.speed_rad_s * s.step_s
        self._integration = integration_of(s.step_s, turn > NARROW_TURN_RAD, f32)
        self._mean_integration = integration_of(s.step_s, True)
        self._history = 0

        if s.knots is None:
            rows = s.horizon
            self._basis = Basis(np.arange(s.horizon), None)
        else:
            first, basis_weights = spline_basis(s.knots, s.horizon)
            rows, self._basis = s.knots, Basis(first, basis_weights.astype(f32))
        self._rows = rows + rows % 2
        blocks = block_count(s.samples)
        padded, pair = blocks * int(BLOCK), 2 * int(BLOCK)
        self._work = Workspace(
            nominal=np.zeros((s.horizon, 2), f32),
            updated=np.zeros((s.horizon, 2), f32),
            knots=aligned_zeros(blocks * self._rows * pair),
            commands=aligned_zeros((self._history + s.horizon) * pair),
            state=aligned_zeros(STATE_SIZE),
            point_costs=aligned_zeros(weights.size * padded),
            costs=aligned_zeros(padded),
            weights=aligned_zeros(padded),
            sums=aligned_zeros(s.horizon * pair),
            report=np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]),
        )
        self._blocks = blocks

    @property
    def task(self) -> Circle:
        """What is planned for."""
        return self._task

    def reset(self) -> None:
        """Forget the last plan, as at a new start; the random numbers go on."""
        self._work.nominal[:] = 0.0
        self._work.report[1] = 0.1
        self._t0_ns = None

    def warm_up(self) -> None:
        """Compile everything that `plan` calls; leaves the planner as after `reset`."""
        step = self._step
        self.plan(0, PlannerState(0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self._step = step
        self.reset()

    def plan(self, now_ns: int, state: PlannerState) -> Plan:
        """Plan from the state; raises NoValidControl if no sampled sequence has a finite cost."""
        s, f32, work = self._settings, np.float32, self._work
        shift_steps = 0.0 if self._t0_ns is None else (now_ns - self._t0_ns) * 1e-9 / s.step_s
        self._t0_ns = now_ns
        origin_x, origin_y = self._task.origin_m
        start = Start(
            f32(state.x_m - origin_x),
            f32(state.y_m - origin_y),
            f32(math.cos(state.yaw_rad)),
            f32(math.sin(state.yaw_rad)),
            f32(state.left_speed_rad_s),
            f32(state.right_speed_rad_s),
            f32(0.0),
        )
        before = (
            (state.sent[-1].left_rad_s, state.sent[-1].right_rad_s)
            if state.sent
            else (state.left_speed_rad_s, state.right_speed_rad_s)
        )
        limits = Limits(
            f32(self._limits.speed_rad_s),
            f32(min(self._limits.acceleration_rad_s2 * s.step_s, 2.0 * self._limits.speed_rad_s)),
            f32(before[0]),
            f32(before[1]),
        )
        task, memory = self._task.terms(0.0, state.x_m, state.y_m, s.step_s, s.horizon, f32)
        sampling = Sampling(
            self._seed, self._step, s.samples, self._blocks, self._rows, f32(s.noise_std_rad_s),
            f32(s.temperature or 0.0), f32(s.target_ess),
        )  # fmt: skip
        self._step += 1
        valid = replan(
            work, sampling, self._history, shift_steps, self._basis, limits, start, self._base, self._effects,
            self._point_weights, self._integration, task, f32(memory),
        )  # fmt: skip
        if not valid:
            self.reset()
            raise NoValidControl(
                "no sampled command sequence has a finite cost; check the state estimate and the model"
            )
        wheel_speeds = work.nominal.astype(np.float64)
        wheel_speeds.setflags(write=False)
        report = work.report
        return Plan(
            t0_ns=now_ns,
            step_s=s.step_s,
            wheel_speeds=wheel_speeds,
            trajectory=self._predict(state, wheel_speeds),
            diagnostics=Diagnostics(
                ess=float(report[0]),
                temperature=float(report[1]),
                cost_min=float(report[2]),
                cost_mean=float(report[3]),
                cost_nominal=float(report[4]),
                retries=0,
                valid_samples=int(report[5]),
            ),
        )

    def _predict(self, state: PlannerState, wheel_speeds: Array) -> Array:
        states = np.empty((wheel_speeds.shape[0] + 1, 5))
        states[0] = (state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s)
        free_run(states, wheel_speeds, 0, 0, self._mean_base, self._mean_effects, self._mean_integration)
        trajectory = states[:, :3]
        trajectory.setflags(write=False)
        return trajectory
