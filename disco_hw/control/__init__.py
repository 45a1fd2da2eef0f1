"""DISCO: the planner, its settings, and the plan as a function of time."""

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

__all__ = [
    "CommandLimits",
    "Diagnostics",
    "Disco",
    "DiscoSettings",
    "NoValidControl",
    "PlanOutcome",
    "PlannerState",
    "Rollouts",
    "Sampler",
    "SentCommand",
    "WheelPlan",
]
