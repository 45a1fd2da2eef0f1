"""Following a task's line backwards: tasks, guide and reference see the robot with its back as its front.

Turned like that the robot faces the other way, its left wheel is its right one, both turn the other way round, and the
centre of rotation lies on the other side of the tracked point. Rollouts stay those of the robot as it is, with all that
its model knows of its sides; only what costs them looks at the turned one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import (
    START_COS,
    START_LEFT,
    START_RIGHT,
    START_SIN,
    Floats,
    Terms,
    follow,
    row_of,
    stage_cost,
    terminal_cost,
)
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.kernel.sequences import Limits
from disco_hw.tasks import Found, PlannedTask, Prepared


class BackwardsTerms(NamedTuple):
    """Terms of a task for a robot that drives backwards; `table` is the task's, or None. Compiled code only."""

    task: Any  # Any: every kind has a named tuple of its own, which the compiler looks into.
    table: NDArray[np.float32] | None

    def stage(
        self, memory: float, step: int, x_old: float, y_old: float, x: float, y: float,
        cos_yaw: float, sin_yaw: float, forward: float, found: Found,
    ) -> tuple[float, float]:  # fmt: skip
        """Return the cost of a step of the turned robot, and the memory after it."""
        return stage_cost(self.task, memory, step, x_old, y_old, x, y, -cos_yaw, -sin_yaw, -forward, found)

    def terminal(self, memory: float, x: float, y: float, cos_yaw: float, sin_yaw: float, found: Found) -> float:
        """Return the cost of the state that the turned robot ends in."""
        return terminal_cost(self.task, memory, x, y, -cos_yaw, -sin_yaw, found)

    def follow(self, memory: float, x: float, y: float, forward: float, found: Found) -> tuple[float, float]:
        """Return the place of the turned robot after a step, and what to keep for its cost."""
        return follow(self.task, memory, x, y, -forward, found)

    def row_of(self, memory: float) -> int:
        """Return the index of the table's row for a place."""
        return row_of(self.task, memory)


@dataclass(frozen=True, eq=False, slots=True)
class Backwards:
    """A task as the planner of a robot takes it that drives backwards."""

    task: PlannedTask

    def prepare(
        self, time_s: float, x_m: float, y_m: float, yaw_rad: float, memory: float | None, step_s: float, horizon: int,
        x_icr_m: float,
    ) -> Prepared:  # fmt: skip
        """Return what the task prepares for the turned robot."""
        made = self.task.prepare(time_s, x_m, y_m, yaw_rad + math.pi, memory, step_s, horizon, -x_icr_m)
        return made._replace(terms=BackwardsTerms(made.terms, getattr(made.terms, "table", None)))


def task_of(terms: Terms) -> Terms:
    """Return the terms of the task itself, forwards or backwards."""
    return terms.task if isinstance(terms, BackwardsTerms) else terms


def turned_start(start: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return where rollouts start, (10,) of `SkidSteer`, for the turned robot."""
    turned = start.copy()
    turned[[START_COS, START_SIN]] = -start[[START_COS, START_SIN]]
    turned[[START_LEFT, START_RIGHT]] = -start[[START_RIGHT, START_LEFT]]
    return turned


def turned_chassis(chassis: SteeredChassis) -> SteeredChassis:
    """Return the chassis of the turned robot."""
    return chassis._replace(x_icr_m=-chassis.x_icr_m)


def guide_backwards(
    guide: Callable[..., None], commands: Floats, terms: Terms, start: NDArray[np.float32],
    chassis: SteeredChassis, before_left: float, before_right: float, limits: Limits, step_s: float,
) -> None:  # fmt: skip
    """Fill `commands` (T, 2) as the compiled `guide` does for a task's terms, for a robot that drives backwards."""
    turned = turned_start(start), turned_chassis(chassis), -before_right, -before_left
    guide(commands, terms, *turned, limits, step_s)
    commands[:] = -commands[:, ::-1]
