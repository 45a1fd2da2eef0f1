"""The sampling update of a plan: sample, roll out, weigh, move; again, or anew, where nothing valid comes out."""

from __future__ import annotations

from disco_hw.control.kernel import Floats
from disco_hw.control.kernel.skid_steer import SkidSteer
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.plan import Diagnostics, DiscoSettings, PlanOutcome
from disco_hw.control.surroundings import Surroundings


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
        around = self._surroundings
        return around is not None and self._optimiser.guide_cost >= around.touching_cost

    def leave_touching_plan(self) -> None:
        """Continue from the best sample where the plan touches something and that sample does not.

        The mean of samples that pass an obstacle on both sides leads through it.
        """
        around, optimiser = self._surroundings, self._optimiser
        if around is None or optimiser.least_cost >= around.touching_cost:
            return
        if optimiser.nominal_cost >= around.touching_cost:
            commands, _ = optimiser.sampled_commands(1)
            if len(commands):
                optimiser.set_nominal(commands[0])

    def diagnostics(self, outcome: PlanOutcome, retries: int, speed_part: float) -> Diagnostics:
        """Return how the last step went, with the part of the task's speed that the wheels can do."""
        ess, temperature, least, mean, nominal, valid = self._optimiser.work.report.tolist()
        collapsed = ess < self._settings.min_ess
        return Diagnostics(ess, temperature, least, mean, nominal, int(valid), retries, collapsed, outcome, speed_part)
