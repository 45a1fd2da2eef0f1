"""Commands and wheel speeds of a disturbed robot as those of an undisturbed one that turns alike, and back.

The planner's model then needs to know nothing of the disturbance. It is what the estimator found of the robot's motion
(`model/coefficients.py`) together with what the wheels lose of their commands (`wheel_loss.py`).
"""

from __future__ import annotations

import numpy as np

from disco_hw.control.plan import Array, DiscoSettings, PlannerState, command_history
from disco_hw.control.rollout_points import RolloutPoints
from disco_hw.control.wheel_loss import WheelLoss
from disco_hw.model.coefficients import NO_DISTURBANCE, NO_SLIDE
from disco_hw.model.step import FreeRun


class DisturbanceCompensation:
    """Follows the disturbance from plan to plan.

    With `offset_free` all of it counts. Without, only its `slide` does where plans are refined, and else nothing.
    """

    def __init__(self, points: RolloutPoints, settings: DiscoSettings) -> None:
        self._points = points
        self._is_full, self._slides = settings.offset_free, settings.offset_free or settings.refine
        self._loss = WheelLoss()
        self._disturbance = NO_DISTURBANCE
        self.slide: Array = NO_SLIDE
        """How the robot slides beside its model (3,): `Disturbance.slides`."""
        self.is_none = True
        """Whether the wheels turn as the model says, and the robot with them."""
        # By the milliseconds between two plans, of the model in force.
        self._wheel_runs: dict[int, FreeRun] = {}
        self._runs_of = points.model

    def slides_in(self, step_s: float) -> tuple[float, float, float]:
        """Return the drift of the robot in a step along x and y (m), and its slide to the left per metre."""
        found = self._disturbance
        return found.drift_x_m_s * step_s, found.drift_y_m_s * step_s, found.left

    def follow(self, now_ns: int, state: PlannerState) -> None:
        """Take the state's disturbance, and what the wheels have lost of their commands since the last plan."""
        if self._slides:
            self._disturbance, self.slide = state.disturbance, state.disturbance.slides
        if not self._is_full:
            return
        self._loss.step(now_ns, state, self._wheels_after)
        self.is_none = self._disturbance.is_none and self._loss.is_none

    def pause(self) -> None:
        """Expect that something else moves the robot for a while; what is known of its wheels stays."""
        self._loss.pause()

    def turning(self, left_rad_s: float, right_rad_s: float) -> tuple[float, float]:
        """Wheel speeds of an undisturbed robot that turns as this one does with these."""
        if self.is_none:
            return left_rad_s, right_rad_s
        return self._disturbance.turning(left_rad_s, right_rad_s, self._points.chassis.axial_distance_m)

    def acting(self, commands: Array) -> Array:
        """Commands (N, 2) to an undisturbed robot that turns as this one does with these."""
        if self.is_none:
            return commands
        acting = self._loss.acting(commands)
        axle_m = self._points.chassis.axial_distance_m
        return np.column_stack(self._disturbance.turning(acting[:, 0], acting[:, 1], axle_m))

    def commanded(self, commands: Array) -> Array:
        """Return the inverse of `acting`."""
        if self.is_none:
            return commands
        left, right = self._disturbance.commanded(commands[:, 0], commands[:, 1], self._points.chassis.axial_distance_m)
        return self._loss.commanded(np.column_stack([left, right]))

    def _wheels_after(self, wheels: tuple[float, float], gap_s: float, state: PlannerState) -> tuple[float, float]:
        """Wheel speeds (rad/s) that the model makes of these and what was sent over so long up to the state."""
        points = self._points
        gap_ms = max(round(gap_s * 1e3), 1)
        run = self._wheel_run(gap_ms)
        sent = command_history(state.sent, state.t_ns, gap_ms * 1e-3, run.past_rows + 1, wheels)
        start = np.array([0.0, 0.0, 0.0, *wheels])
        begin_ns = state.t_ns - gap_ms * 1_000_000
        means = None if points.past is None else points.past.of_mean(state, begin_ns, self._loss.acting, wheels)
        left, right = run.states(start, self._loss.acting(sent), run.past_rows, means=means)[-1, 3:].tolist()
        return left, right

    def _wheel_run(self, gap_ms: int) -> FreeRun:
        model = self._points.model
        if self._runs_of is not model:
            self._wheel_runs, self._runs_of = {}, model
        run = self._wheel_runs.get(gap_ms)
        if run is None:
            run = self._wheel_runs[gap_ms] = FreeRun(model, self._points.mean_theta, gap_ms * 1e-3)
        return run
