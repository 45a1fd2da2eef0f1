"""Events about the planner: when it begins and ceases to fail, to fall back, or to plan from too few samples.

Each is reported once, at the tick in which it changes; a speed that the wheels limit is reported once in a drive.
"""

from __future__ import annotations

from disco_hw.control.plan import WheelPlan
from disco_hw.runtime.pipeline import Source

# Chosen: a smaller loss of speed is within what a robot's speed varies by anyway.
LIMITED_PART = 0.95
FOLLOWS = (Source.PLAN, Source.TAIL, Source.FALLBACK, Source.RAMP)
"""Sources of the command of a robot that follows its task."""


class PlannerEvents:
    """Compares each tick's plan with the last one's; `fallback` names the law that drives where there is no plan."""

    def __init__(self, fallback: str) -> None:
        self._fallback = fallback
        self._failing = self._collapsed = self._fell_back = self._is_limited = False

    def step(self, source: Source, plan: WheelPlan | None, failure: str | None) -> tuple[str, ...]:
        """Return the events of a tick with this command's source, this new plan, or this failure to make one."""
        events: list[str] = []
        failing = failure is not None
        if failing != self._failing:
            events.append(f"planner: {failure}" if failing else "planner: recovered")
        self._failing = failing
        if source not in FOLLOWS:
            self._is_limited = False
        if plan is None:
            return tuple(events)
        found = plan.diagnostics
        fell_back = source is Source.FALLBACK
        if fell_back is not self._fell_back:
            events.append(
                f"planner: no valid plan; the fallback controller {self._fallback} follows the line instead"
                if fell_back
                else "planner: valid plan again; the planner drives"
            )
        self._fell_back = fell_back
        if found.collapsed != self._collapsed:
            few = f"planner: plans rest on {found.ess:.1f} effective samples, too few to trust the plan"
            events.append(few if found.collapsed else "planner: enough effective samples again")
        self._collapsed = found.collapsed
        if found.speed_part < LIMITED_PART and not self._is_limited:
            self._is_limited = True
            events.append(
                f"planner: the speed is limited by the wheels to {found.speed_part:.0%} of the task's; "
                "the robot follows its line more slowly"
            )
        return tuple(events)
