"""A classical follower that takes over for as long as DISCO finds nothing valid, where robot.toml asks for one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.control.baselines import Follower, Kanayama, Law, LinearQuadratic, NominalRobot, PurePursuit, Reference
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.plan import NoValidControl, PlannerState, PlanOutcome, Rollouts, WheelPlan
from disco_hw.control.settings import CommandLimits
from disco_hw.model import Belief
from disco_hw.tasks import PlannedTask

Array = NDArray[np.float64]

LAWS: Mapping[str, Callable[[], Law]] = MappingProxyType(
    {"pure_pursuit": PurePursuit, "kanayama": Kanayama, "lqr": LinearQuadratic}
)
"""By the names of `control.fallback`."""


@runtime_checkable
class Line(Protocol):
    """A planned task along a line at one speed."""

    @property
    def speed_m_s(self) -> float:
        """Along the line."""

    def line_m(self) -> Array:
        """Its points (N, 2) in the order of the drive; the last is the first where it is closed."""


class BelievedPlanner(Protocol):
    """A planner that says which robot it plans for."""

    @property
    def chassis(self) -> SteeredChassis:
        """The mean of what is believed."""

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """Plan from the state; raises NoValidControl."""

    def reset(self) -> None:
        """Forget the last plan."""

    def set_task(self, task: PlannedTask) -> None:
        """Plan for another task of the same kind."""

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief; raises ValueError."""

    def sampled_rollouts(self, count: int) -> Rollouts:
        """The weightiest sequences of the last plan."""


class WithFallback:
    """Plans as `planner` does; where that finds nothing valid, a follower by `law` drives on along the line.

    Its plans have the outcome FALLBACK. The planner is asked in every tick all the same, and has the robot back with
    its first valid plan. From a state that is not finite nobody drives: the planner's ramp to zero stays. Raises
    TypeError for a task without a line.
    """

    def __init__(
        self, planner: BelievedPlanner, law: Callable[[], Law], task: PlannedTask, limits: CommandLimits
    ) -> None:
        self._planner, self._law, self._limits = planner, law, limits
        self._follower = self._along(task)

    def _along(self, task: PlannedTask) -> Follower:
        if not isinstance(task, Line):
            raise TypeError(f"{type(task).__name__} has no line that a follower could drive")
        reference = Reference(task.line_m(), task.speed_m_s, self._planner.chassis.x_icr_m)
        return Follower(reference, self._law(), self._chassis())

    def _chassis(self) -> NominalRobot:
        return NominalRobot(*self._planner.chassis, self._limits)

    def plan(self, now_ns: int, state: PlannerState) -> WheelPlan:
        """The planner's plan, or the follower's; raises NoValidControl where neither can be."""
        numbers = state.x_m, state.y_m, state.yaw_rad, state.left_speed_rad_s, state.right_speed_rad_s
        finite = all(map(math.isfinite, numbers))
        try:
            plan = self._planner.plan(now_ns, state)
        except NoValidControl:
            if not finite:
                raise
        else:
            if plan.diagnostics.outcome is not PlanOutcome.STOPPING:
                self._follower.watch(state)
                return plan
            if not finite:
                return plan
        steered = self._follower.plan(now_ns, state)
        found = msgspec.structs.replace(steered.diagnostics, outcome=PlanOutcome.FALLBACK)
        return msgspec.structs.replace(steered, diagnostics=found)

    def reset(self) -> None:
        """Forget the last plan and the place on the line."""
        self._planner.reset()
        self._follower.reset()

    def set_task(self, task: PlannedTask) -> None:
        """Plan and follow another task of the same kind."""
        self._planner.set_task(task)
        self._follower = self._along(task)

    def set_belief(self, belief: Belief) -> None:
        """Plan under this belief, and steer a robot of its mean; the line's headings stay. Raises ValueError."""
        self._planner.set_belief(belief)
        self._follower.set_chassis(replace(self._chassis(), x_icr_m=self._follower.x_icr_m))

    def sampled_rollouts(self, count: int) -> Rollouts:
        """The planner's, of its last plan."""
        return self._planner.sampled_rollouts(count)
