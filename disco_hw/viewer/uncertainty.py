"""A plan as each of the model's sigma points would drive it, so that the parameters' uncertainty can be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.parameter_points import unscented_points
from disco_hw.effects.registry import DELAY
from disco_hw.log.records import Plan
from disco_hw.model import Model
from disco_hw.model.plain import RobotState, delayed, step, theta_of

Array = NDArray[np.float64]


class ParameterPoints:
    """The sigma points of a model's belief, ready to roll plans out; the mean alone if nothing is believed."""

    def __init__(self, model: Model, alpha: float = 1.0) -> None:
        points, _ = unscented_points(model, alpha)
        self._names = model.parameter_names
        self._points = points

    def trajectories(self, plan: Plan, wheel_speeds: tuple[float, float]) -> Array:
        """Positions (L, T + 1, 2) m of L sigma points from the plan's start, under its commands; (0, 0, 2) without.

        `wheel_speeds` (left, right) rad/s at the start. Commands sent before the plan are taken as its first.
        """
        if not plan.path_x_m or not plan.left_rad_s:
            return np.empty((0, 0, 2))
        commands = np.column_stack((plan.left_rad_s, plan.right_rad_s))
        paths = [self._path(point, plan, commands, wheel_speeds) for point in self._delay_groups()]
        return np.concatenate(paths)

    def _delay_groups(self) -> list[Array]:
        """Points that can be stepped together: a delay shifts whole rows of commands."""
        if DELAY.columns[0] not in self._names:
            return [self._points]
        return [point[None] for point in self._points]

    def _path(self, points: Array, plan: Plan, commands: Array, wheel_speeds: tuple[float, float]) -> Array:
        theta = theta_of(self._names, points)
        if len(points) == 1:
            single = theta_of(self._names, points[0])
            commands = delayed(np.vstack((commands[:1], commands)), 1, single, plan.step_s)
        ones = np.ones(len(points))
        state = RobotState(
            plan.path_x_m[0] * ones,
            plan.path_y_m[0] * ones,
            plan.path_yaw_rad[0] * ones,
            wheel_speeds[0] * ones,
            wheel_speeds[1] * ones,
        )
        path = np.empty((len(points), len(commands) + 1, 2))
        path[:, 0] = np.stack((state.x, state.y), axis=-1)
        for index, (left, right) in enumerate(commands):
            state, _, _ = step(theta, state, left, right, plan.step_s, index * plan.step_s)
            path[:, index + 1] = np.stack((state.x, state.y), axis=-1)
        return path
