"""The parameter points of a belief as the compiled rollout takes them: weights, coefficient tables, shared rollouts.

Sizes and types are laid out for the first belief. A later one is taken without compiling anything, or refused.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.parameter_points import (
    equivalent_points,
    mean_point,
    point_estimate,
    sampled_points,
    shared_pairs,
    unscented_points,
)
from disco_hw.control.past_motion import DELAYED_BY, PastMotion
from disco_hw.control.plan import Array, CommandLimits, DiscoSettings
from disco_hw.effects import Channel
from disco_hw.model import Belief, Model
from disco_hw.model.model import BASE_PARAMETERS, coefficient_tables
from disco_hw.model.step import FreeRun, integration_series

NARROW_TURN_RAD = 0.4
"""Largest turn in a step for which the short series of the arc is exact to 1e-7 (`model.step.integration_series`)."""
SPARE_HISTORY = 2
"""Steps kept beyond the longest delay that is believed in at first, for later beliefs."""


class RolloutPoints:
    """The points that every command sequence is rolled out under, and the robot in their mean.

    Fixed: `weights` (L,) float32, `history` steps of past commands, and what the fields of `SkidSteer` of the same
    names mean: `each`, `skip_mean`, `series`, `wide`, `euler`. Of the belief in force: the `model`, the mean
    `mean_theta` (1, P), by name in `mean`, and its `chassis`, `mean_run` and `run` in steps of
    the plan under the mean and under each point, the `past` that they remember, and `base`, `effects`, `ahead`,
    `scaled`, `wheels_differ` of `SkidSteer`.
    """

    def __init__(self, model: Model, settings: DiscoSettings, limits: CommandLimits, seed: int) -> None:
        self._settings, self._limits, self._seed = settings, limits, seed
        self.model = model
        self.is_sampled = settings.uncertainty in ("mc", "joint")
        has_own_samples = settings.uncertainty == "joint" or (
            settings.uncertainty == "mc" and not settings.common_draws
        )
        self.each = True if has_own_samples else None
        theta, weights = self._shared(model)
        self.weights = weights.astype(np.float32)
        self.skip_mean = True if self.weights[0] == 0.0 and not has_own_samples else None
        delay_is_believed = model.belief is not None and DELAYED_BY in model.belief.names
        self.history = self._history_for(model, theta) + (SPARE_HISTORY if delay_is_believed else 0)
        may_turn_more = self.is_sampled or any(s.effect.may_turn_more for s in model.effects)
        self.wide = True if may_turn_more or self._largest_turn_rad(theta) > NARROW_TURN_RAD else None
        self.series = integration_series(settings.step_s, self.wide is not None, np.float32)
        self.euler = True if settings.euler else None
        # The axle's path under Euler steps depends on x_icr.
        self._pairs = 0 if settings.euler else shared_pairs(model, theta, settings.step_s)
        self._set_parameters(model, theta)

    def set_belief(self, belief: Belief) -> None:
        """Take the points of another belief; raises ValueError, and keeps the old ones, where they do not fit."""
        old = self.model.belief
        names = None if old is None else old.names
        if names is None or set(belief.names) != set(names):
            raise ValueError(f"belief over {belief.names}, but the planner was laid out for one over {names}")
        model = replace(self.model, belief=belief)
        theta, weights = self._shared(model)
        if not np.isfinite(theta).all() or weights.size != self.weights.size:
            raise ValueError("the belief's points are not finite, or not as many as before")
        if self._history_for(model, theta) > self.history:
            raise ValueError(f"{DELAYED_BY}: longer than the {self.history} steps of commands that the planner keeps")
        if self.wide is None and self._largest_turn_rad(theta) > NARROW_TURN_RAD:
            raise ValueError(f"the wheels would turn the robot by more than {NARROW_TURN_RAD} rad in a step")
        self._set_parameters(model, theta)

    def draw(self, step_number: int, samples: int) -> None:
        """Draw the points of `mc` and `joint` anew; `samples` of the optimiser, each with points of its own."""
        count = self.weights.size * (1 if self.each is None else samples)
        theta = sampled_points(self.model, count, self._seed, step_number)
        self.base, self.effects = coefficient_tables(self.model, theta, self._settings.step_s, np.float32)

    def _shared(self, model: Model) -> tuple[Array, Array]:
        """Parameter points (L, P) and weights (L,) of the first step; those of `ut` and `point` stay."""
        settings = self._settings
        match settings.uncertainty:
            case "ut":
                return unscented_points(model, settings.ut_alpha)
            case "point":
                return point_estimate(model)
            case "mc":
                count = settings.draws
            case "joint":
                count = 1
        return sampled_points(model, count, self._seed, 0), np.full(count, 1.0 / count)

    def _set_parameters(self, model: Model, theta: Array) -> None:
        """Put the points (L, P) of a model in force."""
        step_s = self._settings.step_s
        self.model, self.theta, self.mean_theta = model, theta, mean_point(model)
        self.mean = dict(zip(model.parameter_names, self.mean_theta[0].tolist(), strict=True))
        self.mean_run, self.run = FreeRun(model, self.mean_theta, step_s), FreeRun(model, theta, step_s)
        delayed = [f"{s.name}.{s.effect.delayed_by}" for s in model.effects if s.effect.delayed_by is not None]
        dead = [f"{s.name}.{s.effect.dead_by}" for s in model.effects if s.effect.dead_by is not None]
        response_s = sum(_largest(model, self.mean_theta, name) for name in delayed)
        dead_rad_s = sum(_largest(model, self.mean_theta, name) for name in dead)
        radius_m, axle_m, x_icr_m = self.mean_theta[0, : len(BASE_PARAMETERS)].tolist()
        self.chassis = SteeredChassis(radius_m, axle_m, x_icr_m, float(response_s), float(dead_rad_s))
        self.base, self.effects = coefficient_tables(model, theta, step_s, np.float32)
        found = equivalent_points(model, theta, step_s, self._pairs)
        self.ahead, self.scaled = (_pair(found, number) if number < self._pairs else None for number in (0, 1))
        self.wheels_differ = _do_wheels_differ(model, theta)
        self.past = PastMotion.of(model, theta, self.mean_theta)

    def _largest_turn_rad(self, theta: Array) -> float:
        """Largest turn in a step under the points (L, P)."""
        ratio = float((theta[:, 0] / theta[:, 1]).max())
        return 2.0 * self._limits.speed_rad_s * self._settings.step_s * ratio

    def _history_for(self, model: Model, theta: Array) -> int:
        """Return the number of past commands that the points (L, P) and the mean look back on."""
        longest_s = max(_largest(model, each, DELAYED_BY) for each in (theta, mean_point(model)))
        delay_steps = longest_s / self._settings.step_s
        return 0 if delay_steps == 0.0 else math.floor(delay_steps) + 1


def _largest(model: Model, theta: Array, name: str) -> float:
    """Largest value of a parameter in points (L, P); 0 if the model does not have it."""
    names = model.parameter_names
    return float(theta[:, names.index(name)].max()) if name in names else 0.0


def _pair(found: NDArray[np.int64], number: int) -> NDArray[np.int64]:
    """Return the two columns (L, 2) of one pair of `equivalent_points`."""
    return np.ascontiguousarray(found[:, 2 * number : 2 * number + 2])


def _do_wheels_differ(model: Model, theta: Array) -> bool:
    """Whether the points (L, P) differ in a parameter between command and wheel."""
    differing = {name for name, column in zip(model.parameter_names, theta.T, strict=True) if np.ptp(column)}
    wheel_effects = [s for s in model.effects if s.effect.channel is Channel.COMMAND_TO_WHEEL]
    names = {f"{setting.name}.{key}" for setting in wheel_effects for key in setting.values}
    if any(setting.effect.uses_geometry for setting in wheel_effects):
        names |= {parameter.name for parameter in BASE_PARAMETERS}
    return bool(names & differing)
