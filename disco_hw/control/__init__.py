"""DISCO: the planner, its tasks, and the plan as a function of time."""

from disco_hw.control.disco import Disco
from disco_hw.control.plan import Diagnostics, NoValidControl, Outcome, Plan, PlannerState, Rollouts, SentCommand
from disco_hw.control.settings import DiscoSettings, Sampler, WheelLimits
from disco_hw.control.tasks.circle import Circle
from disco_hw.control.tasks.of_robot import task_of_robot
from disco_hw.control.tasks.path import Path
from disco_hw.control.tasks.task import Task
from disco_hw.control.tasks.timed_path import TimedPath

__all__ = [
    "Circle",
    "Diagnostics",
    "Disco",
    "DiscoSettings",
    "NoValidControl",
    "Outcome",
    "Path",
    "Plan",
    "PlannerState",
    "Rollouts",
    "Sampler",
    "SentCommand",
    "Task",
    "TimedPath",
    "WheelLimits",
    "task_of_robot",
]
