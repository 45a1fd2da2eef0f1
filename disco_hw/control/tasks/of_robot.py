"""The task of robot.toml as the planner takes it."""

from __future__ import annotations

from disco_hw.config import CircleTask, RobotTask
from disco_hw.control.tasks.circle import Circle
from disco_hw.control.tasks.path import Path


def task_of_robot(task: RobotTask, mode: str = "default") -> Circle | Path:
    """The task with the cost of the control mode, which a path has only one of."""
    return Circle.from_config(task, mode) if isinstance(task, CircleTask) else Path.from_config(task)
