"""A control law of your own in DISCO's place: a function from the robot's state to wheel speeds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from disco_hw.control.plan import Diagnostics, NoValidControl, PlannerState, PlanOutcome, Rollouts, WheelPlan
from disco_hw.model import Belief, Model

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
