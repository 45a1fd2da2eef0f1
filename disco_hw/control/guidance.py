"""Guidance along the task's line: a steering law's commands as one sample, and as the plan where that stands still."""

from __future__ import annotations

import math
from collections.abc import Callable

from disco_hw.control.kernel.guide import SteeredChassis, guide
from disco_hw.control.kernel.skid_steer import SkidSteer
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.plan import Array, DiscoSettings
from disco_hw.jit import compiled_for

NEAR_ZERO_SPEED = 0.25
"""A plan stands that in its first half gets nowhere further away than this part of the way that it is to go."""


class Guidance:
    """Makes the guide (`kernel/guide.py`) of every step, and says when it has the robot."""

    def __init__(self, optimiser: Optimiser, settings: DiscoSettings) -> None:
        self._optimiser, self._settings = optimiser, settings
        self._guide: Callable[..., None] | None = None
        self.until_ns: int | None = None
        """Until when the guide has the robot, however good the plan is; None if the plan has it."""

    @property
    def is_made(self) -> bool:
        """Whether a guide was made so far."""
        return self._guide is not None

    def reset(self) -> None:
        """Give the robot back to the plan."""
        self.until_ns = None

    def offer(self, system: SkidSteer, chassis: SteeredChassis, before: tuple[float, float]) -> bool:
        """Make the guide a sample of the next step; returns whether the task has a line to be guided along."""
        optimiser = self._optimiser
        if self._settings.guide_below <= 0.0 or not hasattr(system.task, "way_ahead_m"):
            optimiser.sample_guide(False)
            return False
        optimiser.sample_guide(True)
        commands, step_s = optimiser.work.guide, self._settings.step_s
        arguments = commands, system.task, system.start, chassis, *before, optimiser.limits, step_s
        if self._guide is None:
            self._guide = compiled_for(guide, *arguments)
        self._guide(*arguments)
        return True

    def has_robot(self, now_ns: int, system: SkidSteer, trajectory: Array) -> bool:
        """Whether the guide has the robot: for a horizon from a plan on that stands, as across the line or far off it.

        Turning in from there costs more than standing for as long as is planned, or is put off from plan to plan.
        """
        settings = self._settings
        horizon_s = settings.sampler.horizon * settings.step_s
        half = min(settings.sampler.horizon // 2, len(trajectory) - 1)
        way_m = system.task.way_ahead_m(half * settings.step_s)
        # From the last place on: that of a plan which does not stand is far enough.
        begin, *places = trajectory[: half + 1, :2].tolist()
        if all(math.dist(begin, place) < NEAR_ZERO_SPEED * way_m for place in reversed(places)):
            self.until_ns = now_ns + round(horizon_s * 1e9)
        return self.until_ns is not None and now_ns < self.until_ns
