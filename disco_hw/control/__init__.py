"""DISCO: the planner, its tasks, and the plan as a function of time."""

from disco_hw.control.disco import Disco
from disco_hw.control.plan import (
    Diagnostics,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Rollouts,
    SentCommand,
    WheelPlan,
)
from disco_hw.control.settings import CommandLimits, DiscoSettings, Sampler
from disco_hw.control.tasks.circle import Circle
from disco_hw.control.tasks.of_robot import task_of_robot
from disco_hw.control.tasks.path import Path
from disco_hw.control.tasks.task import Task
from disco_hw.control.tasks.timed_path import TimedPath

__all__ = [
    "Circle",
    "CommandLimits",
    "Diagnostics",
    "Disco",
    "DiscoSettings",
    "NoValidControl",
    "Path",
    "PlanOutcome",
    "PlannerState",
    "Rollouts",
    "Sampler",
    "SentCommand",
    "Task",
    "TimedPath",
    "WheelPlan",
    "task_of_robot",
]
