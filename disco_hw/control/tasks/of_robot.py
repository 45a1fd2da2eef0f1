"""The task of robot.toml as the planner takes it."""

from __future__ import annotations

from disco_hw.config import CircleTask, PathTask, RobotTask
from disco_hw.control.tasks.circle import Circle
from disco_hw.control.tasks.path import Path
from disco_hw.control.tasks.timed_path import TimedPath


def task_of_robot(task: RobotTask, mode: str = "default") -> Circle | Path | TimedPath:
    """The task with the cost of the control mode, which a path has only one of."""
    match task:
        case CircleTask():
            return Circle.from_config(task, mode)
        case PathTask():
            return Path.from_config(task)
        case _:
            return TimedPath.from_config(task)
