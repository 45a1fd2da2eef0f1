"""DISCO: the planner, its tasks, and the plan as a function of time."""

from disco_hw.control.disco import Disco
from disco_hw.control.plan import Diagnostics, NoValidControl, Plan, PlannerState, SentCommand
from disco_hw.control.settings import DiscoSettings, WheelLimits
from disco_hw.control.tasks.circle import Circle

__all__ = [
    "Circle",
    "Diagnostics",
    "Disco",
    "DiscoSettings",
    "NoValidControl",
    "Plan",
    "PlannerState",
    "SentCommand",
    "WheelLimits",
]
