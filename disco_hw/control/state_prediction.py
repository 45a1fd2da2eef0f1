"""Start of a plan: the state when its first command acts, earlier commands, and means of past motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from disco_hw.control.plan import Array, CommandLimits, DiscoSettings, PlannerState, command_history
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.model import plain
from disco_hw.model.drift import NO_DRIFT_M_S
from disco_hw.model.step import FreeRun

SHORTEST_GAP_S = 1e-6
"""A state less than this before a plan's start, a thousandth of a tick's jitter, is taken as the start itself."""


class PlanStart(NamedTuple):
    """Where a plan starts, and what was before.

    `state` (5,): x, y (m), yaw (rad), wheel speeds (rad/s) at `t0_ns`, `elapsed_s` after the drive began. `before`: the
    commands that the plan's first change is limited from. `earlier` (history, 2): commands before the plan, in its
    steps. `drift` (2,) and `lateral_lag_s`: those of the state. `mean_means` (n,), `point_means` (L, n): what
    the model's terms remember,
    in the mean of what is believed and under each point; None where they remember nothing.
    """

    t0_ns: int
    elapsed_s: float
    state: Array
    before: tuple[float, float]
    earlier: Array
    drift: Array
    lateral_lag_s: float
    mean_means: Array | None
    point_means: Array | None

    @classmethod
    def at_rest(cls, history: int) -> PlanStart:
        """Return the start of a robot that stands at the origin, with so many commands before."""
        return cls(0, 0.0, np.zeros(5), (0.0, 0.0), np.zeros((history, 2)), NO_DRIFT_M_S, 0.0, None, None)

    def mean_path(self, run: FreeRun, commands: Array) -> Array:
        """Poses (T + 1, 3) that commands (T, 2) lead through in the mean of what is believed."""
        return self._path(run, commands, self.mean_means, 0)

    def point_path(self, run: FreeRun, commands: Array, point: int) -> Array:
        """Poses (T + 1, 3) that commands (T, 2) lead through under one point."""
        return self._path(run, commands, None if self.point_means is None else self.point_means[point], point)

    def _path(self, run: FreeRun, commands: Array, means: Array | None, point: int) -> Array:
        history = len(self.earlier)
        history_and_plan = np.concatenate([self.earlier, commands]) if history else commands
        # A run overwrites the means.
        slip_means = None if means is None else means.copy()
        return run.states(self.state, history_and_plan, history, self.elapsed_s, point, self.drift, slip_means)[:, :3]


class StatePrediction:
    """Predicts the state to a plan's start, under the mean parameters and the commands already sent."""

    def __init__(self, points: RolloutPoints, settings: DiscoSettings, limits: CommandLimits) -> None:
        self._points, self._settings, self._limits = points, settings, limits

    def start(self, state: PlannerState, t0_ns: int, elapsed_s: float) -> PlanStart:
        """Return where a plan that acts from `t0_ns` on begins, `elapsed_s` after the drive began."""
        points = self._points
        before = self.anchor(state, elapsed_s)
        # Sampled plans know of no drift, and are judged without it.
        drift = state.drift.vector if self._settings.refine else NO_DRIFT_M_S
        mean_means = point_means = None
        if points.past is not None:
            mean_means = points.past.of_mean(state, state.t_ns)
        predicted = self._predicted(state, t0_ns, elapsed_s, drift, mean_means)
        if points.past is not None and mean_means is not None:
            point_means = points.past.of_points(state, t0_ns, mean_means)
        earlier = np.zeros((0, 2))
        if points.history:
            earlier = self.commands_before(state, t0_ns, self._settings.step_s, points.history)
        return PlanStart(
            t0_ns, elapsed_s, predicted, before, earlier, drift, state.lateral_lag_s, mean_means, point_means
        )  # fmt: skip

    def anchor(self, state: PlannerState, elapsed_s: float) -> tuple[float, float]:
        """Commands that the plan's first change is limited from.

        The last ones sent; but no further from the measured wheel speeds than the wheels could be behind them, or than
        the model says that they stay, so that a plan does not run away from wheels that are held back.
        """
        wheels = state.left_speed_rad_s, state.right_speed_rad_s
        if not state.sent:
            return wheels
        settings, points, last = self._settings, self._points, state.sent[-1]
        sent = aims = last.left_rad_s, last.right_rad_s
        if points.model.effects and not settings.euler:
            # Within a dead band wheels do not follow their command at all; what remembers commands counts as of a
            # robot that stood. The paper's mode stays as it is.
            now = plain.RobotState(0.0, 0.0, 0.0, *wheels)
            aim_left, aim_right = plain.wheel_targets(points.mean, now, *sent, elapsed_s, settings.step_s)
            aims = float(aim_left), float(aim_right)
        slack = self._limits.acceleration_rad_s2 * (settings.step_s + points.chassis.response_s)
        left, right = (
            min(max(command, wheel - slack - abs(command - aim)), wheel + slack + abs(command - aim))
            for command, wheel, aim in zip(sent, wheels, aims, strict=True)
        )
        return left, right

    def commands_before(self, state: PlannerState, end_ns: int, step_s: float, count: int) -> Array:
        """Mean commands (count, 2) that act in each of the steps up to `end_ns`."""
        wheels = state.left_speed_rad_s, state.right_speed_rad_s
        return command_history(state.sent, end_ns, step_s, count, wheels)

    def _predicted(
        self, state: PlannerState, t0_ns: int, elapsed_s: float, drift: Array, means: Array | None
    ) -> Array:  # fmt: skip
        """State (5,) at `t0_ns`; sets `means` to what is remembered then."""
        start = np.array([state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s])
        gap_s = (t0_ns - state.t_ns) * 1e-9
        if gap_s < SHORTEST_GAP_S:
            return start
        count = math.ceil(gap_s / self._settings.step_s)
        run = FreeRun(self._points.model, self._points.mean_theta, gap_s / count)
        past = self.commands_before(state, t0_ns, gap_s / count, run.past_rows + count)
        return np.asarray(run.states(start, past, run.past_rows, elapsed_s - gap_s, 0, drift, means)[-1])
