"""The sampling update of a plan: sample, roll out, weigh, move; again, or anew, where nothing valid comes out.

Beside it the guide along the task's line, as one sample, and as the plan where that stands still. Where nothing is
found at all: a ramp to zero for a while, then no plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from disco_hw.control.backwards import guide_backwards, task_of
from disco_hw.control.kernel import START_LEFT, START_RIGHT, Floats
from disco_hw.control.kernel.avoid import TOUCH_COST
from disco_hw.control.kernel.guide import SteeredChassis, guide
from disco_hw.control.kernel.skid_steer import SkidSteer
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.plan import (
    Array,
    CommandLimits,
    Diagnostics,
    DiscoSettings,
    NoValidControl,
    PlanOutcome,
    ramp_to_zero,
)
from disco_hw.control.surroundings import Surroundings
from disco_hw.jit import compiled_for


class Sampling:
    """Improves the optimiser's plan under the points' `weights` (L,), away from what stands around."""

    def __init__(
        self, optimiser: Optimiser, weights: Floats, settings: DiscoSettings, surroundings: Surroundings | None
    ) -> None:
        self._optimiser, self._weights = optimiser, weights
        self._settings, self._surroundings = settings, surroundings

    def improve(
        self, shift_steps: float, before: tuple[float, float], system: SkidSteer, first: bool, guided: bool
    ) -> tuple[PlanOutcome, int]:
        """Try until a step is valid; returns how it went and the attempts beyond the first.

        `first`: whether there was no plan before; `guided`: whether sample 1 is the guide, which replaces the plan
        where it is that much better.
        """
        settings, optimiser, weights = self._settings, self._optimiser, self._weights
        retries = 0
        gain = 1.0 if first or not settings.gain_by_time else min(shift_steps, 1.0)
        usable = optimiser.step(shift_steps, gain, before, system, weights)
        while retries < settings.retries and not (usable and optimiser.ess >= settings.min_ess):
            retries += 1
            usable = optimiser.step(0.0, gain, before, system, weights) or usable
        outcome = PlanOutcome.RETRIED if retries else PlanOutcome.PLANNED
        if not usable:
            optimiser.reset()
            outcome = PlanOutcome.RESTARTED
            retries += 1
            usable = optimiser.step(0.0, 1.0, before, system, weights)
        if not usable:
            return PlanOutcome.STOPPING, retries
        if guided and optimiser.guide_is_better(settings.guide_below):
            optimiser.use_guide()
        if first or outcome is PlanOutcome.RESTARTED:
            for _ in range(settings.iterations_at_start - 1):
                optimiser.step(0.0, 1.0, before, system, weights)
        return outcome, retries

    @property
    def is_trapped(self) -> bool:
        """Whether every sample of the last step touches the fence or an obstacle for most of the horizon."""
        around = self._surroundings
        return around is not None and self._optimiser.least_cost >= around.trapped_cost

    @property
    def guide_touches(self) -> bool:
        """Whether the guide of the last step touches the fence or an obstacle."""
        return self._surroundings is not None and self._optimiser.guide_cost >= TOUCH_COST

    def leave_touching_plan(self) -> None:
        """Continue from the best sample where the plan touches something and that sample does not.

        The mean of samples that pass an obstacle on both sides leads through it.
        """
        optimiser = self._optimiser
        if self._surroundings is not None and optimiser.least_cost < TOUCH_COST <= optimiser.nominal_cost:
            commands, _ = optimiser.sampled_commands(1)
            if len(commands):
                optimiser.set_nominal(commands[0])

    def diagnostics(self, outcome: PlanOutcome, retries: int, speed_part: float) -> Diagnostics:
        """Return how the last step went, with the part of the task's speed that the wheels can do."""
        ess, temperature, least, mean, nominal, valid = self._optimiser.work.report.tolist()
        collapsed = ess < self._settings.min_ess
        return Diagnostics(ess, temperature, least, mean, nominal, int(valid), retries, collapsed, outcome, speed_part)


NEAR_ZERO_SPEED = 0.25
"""A plan stands that in its first half gets nowhere further away than this part of the way that it is to go."""


class Guidance:
    """Makes the guide (`kernel/guide.py`) of every step, and says when it has the robot."""

    def __init__(self, optimiser: Optimiser, settings: DiscoSettings) -> None:
        self._optimiser, self._settings = optimiser, settings
        self._guide: Callable[..., None] | None = None
        self.until_ns: int | None = None
        """Until when the guide has the robot, however good the plan is; None if the plan has it."""

    def reset(self) -> None:
        """Give the robot back to the plan."""
        self.until_ns = None

    def offer(self, system: SkidSteer, chassis: SteeredChassis, before: tuple[float, float]) -> bool:
        """Make the guide a sample of the next step; returns whether the task has a line to be guided along."""
        optimiser = self._optimiser
        terms = task_of(system.task)
        if self._settings.guide_below <= 0.0 or not hasattr(terms, "way_ahead_m"):
            optimiser.sample_guide(False)
            return False
        optimiser.sample_guide(True)
        commands, step_s = optimiser.work.guide, self._settings.step_s
        arguments = system.start, chassis, *before, optimiser.limits, step_s
        if self._guide is None:
            self._guide = compiled_for(guide, commands, terms, *arguments)
        if self._settings.backwards:
            guide_backwards(self._guide, commands, terms, *arguments)
        else:
            self._guide(commands, terms, *arguments)
        return True

    def has_robot(
        self, now_ns: int, system: SkidSteer, chassis: SteeredChassis, trajectory: Array, is_refined: bool
    ) -> bool:
        """Whether the guide has the robot: for a horizon from a plan on that stands, as across the line or far off it.

        Turning in from there costs more than standing for as long as is planned, or is put off from plan to plan. One
        that `is_refined` is slow where the wheels must be, as at a corner, and gives up by itself where it stands.
        """
        settings = self._settings
        horizon_s = settings.sampler.horizon * settings.step_s
        half = min(settings.sampler.horizon // 2, len(trajectory) - 1)
        way_m = task_of(system.task).way_ahead_m(half * settings.step_s)
        # From the last place on: that of a plan which does not stand is far enough.
        begin, *places = trajectory[: half + 1, :2].tolist()
        # A robot that is on its way brakes by such a plan, as before a corner, and does not stand.
        rolls_m_s = 0.5 * chassis.wheel_radius_m * abs(float(system.start[START_LEFT] + system.start[START_RIGHT]))
        is_slow = not is_refined and rolls_m_s * half * settings.step_s < NEAR_ZERO_SPEED * way_m
        if is_slow and all(math.dist(begin, place) < NEAR_ZERO_SPEED * way_m for place in reversed(places)):
            self.until_ns = now_ns + round(horizon_s * 1e9)
        return self.until_ns is not None and now_ns < self.until_ns


TRAPPED = (
    "no way past the fence or an obstacle was found, and the robot stops before it; clear the way, or "
    "drive it away from there"
)


class Stopping:
    """Ramps commands to zero within the limits, for at most `decay_s` on end."""

    def __init__(self, settings: DiscoSettings, limits: CommandLimits) -> None:
        self._settings, self._limits = settings, limits
        self._since_ns: int | None = None

    def end(self) -> None:
        """Note that there is a valid plan again, or none is asked for."""
        self._since_ns = None

    def ramp(self, now_ns: int, before: tuple[float, float], is_trapped: bool) -> Array:
        """Commands (T, 2) from those `before` to zero; raises NoValidControl when that has gone on for `decay_s`.

        `is_trapped`: whether it stops because everything in reach touches the fence or an obstacle.
        """
        decay_s = self._settings.decay_s
        if self._since_ns is None:
            self._since_ns = now_ns
        if (now_ns - self._since_ns) * 1e-9 >= decay_s:
            if is_trapped:
                raise NoValidControl(TRAPPED)
            raise NoValidControl(
                f"no command sequence had a finite cost for {decay_s} s, in spite of retries and a "
                "restart; check the pose, the wheel speeds and the model"
            )
        start = np.nan_to_num(np.clip(np.array(before), -self._limits.speed_rad_s, self._limits.speed_rad_s))
        return ramp_to_zero(start, self._limits, self._settings.step_s, self._settings.sampler.horizon)
