"""The planner DISCO, its settings, and the plan as a function of time."""

from disco_hw.control.disco import Disco
from disco_hw.control.plan import (
    CommandLimits,
    Diagnostics,
    DiscoSettings,
    NoValidControl,
    PlannerState,
    PlanOutcome,
    Rollouts,
    Sampler,
    SentCommand,
    WheelPlan,
)

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
