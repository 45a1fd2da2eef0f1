"""Refinement of DISCO's plan beside the task's line: a few Gauss-Newton steps from the better of two plans.

Sampling is the global search and the fallback. Its plan and the last refined one are both costed against a timed
reference (`kernel/reference.py`), under the points of the belief; the cheaper one is improved (`kernel/refine.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import Terms
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.kernel.reference import timed_reference
from disco_hw.control.kernel.refine import CHANNELS, STATE_COLUMNS, Buffers, Problem, refine
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.plan import CommandLimits
from disco_hw.effects.registry import DELAY
from disco_hw.jit import compiled_for
from disco_hw.model import Model
from disco_hw.model.added_terms import new_means
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import FreeRun, integration_series

Array = NDArray[np.float64]

# Chosen: longer looks further ahead, and takes more than its share of time.
STEPS, STEP_S = 15, 0.1
# Chosen: each takes its time of the tick; the next tick begins from what this one found.
ITERATIONS = 2
# A change of a wheel's rim speed costs as much as the distance that it covers in this time.
CHANGE_S = 0.2
# What lies beyond the horizon: who follows the line exactly with the tracked point behind the centre of rotation turns
# away from the heading that stays on it, e-fold over each x_icr of the way. So the end, distance and x_icr times the
# error of the heading, counts as much as over so many times x_icr more of the way.
END_X_ICR = 5.0
LEAST_END_WEIGHT = 10.0
# The robot is beside the line within this part of the way that the horizon covers, and facing within this cosine.
LATERAL_PART, FACING = 0.3, 0.5


class RefinementStart(NamedTuple):
    """Initial state of a refinement.

    `terms` of the task and `begin` (11,) as of `SkidSteer`; `start` (5,) in the world; `elapsed_s` there; `slide` (3,)
    as of `Disturbance.slides`; `means` (L, n) or None; `past` (H, 2) commands before the plan and `before` the last.
    """

    terms: Terms
    begin: NDArray[np.float32]
    start: Array
    elapsed_s: float
    slide: Array
    means: Array | None
    past: Array
    before: tuple[float, float]


class Refinement:
    """Improves plans for robots beside their line; keeps its last plan as the start of the next."""

    def __init__(self, limits: CommandLimits) -> None:
        self._limits = limits
        self._reference = np.zeros((STEPS, CHANNELS), np.float32)
        self._found = np.ones(5, np.float32)
        self._start, self._before = np.zeros(5), np.zeros(CHANNELS)
        self._compiled: dict[str, Callable[..., float]] = {}
        self._last: Array | None = None
        self._last_ns = 0
        self._buffers: Buffers | None = None
        self.history = 0

    @property
    def speed_part(self) -> float:
        """The part of the task's speed that the wheels can do ahead, at the last refinement; 1 if all of it."""
        return float(self._found[2])

    @property
    def is_compiled(self) -> bool:
        """Whether a refinement would compile nothing any more."""
        return "refine" in self._compiled

    def reset(self) -> None:
        """Forget the last plan."""
        self._last = None
        self._found[:] = 1.0

    def set_points(self, model: Model, theta: Array, weights: Array, chassis: SteeredChassis) -> None:
        """Refine under these points (L, P) of these weights (L,) from now on."""
        counted = np.flatnonzero(weights > 0.0)
        self._chassis = chassis
        self.mean = FreeRun(model, mean_point(model), STEP_S)
        base, effects = coefficient_tables(model, theta[counted], STEP_S)
        self._counted, self._weights = counted, weights[counted].astype(np.float64)
        self._base, self._effects = base, effects
        delay = getattr(effects, DELAY.name, None)
        history = max(self.mean.past_rows, 0 if delay is None else int(delay[0].max()) + 1)
        self._series = integration_series(STEP_S, wide=True)
        if self._buffers is None or history > self.history:
            self.history = history
            self._buffers = _buffers(history, new_means(effects))

    def improve(self, initial: RefinementStart, t0_ns: int, nominal: Array, step_s: float) -> Array | None:
        """Return commands (STEPS, 2) that cost less than the plan `nominal` in steps of `step_s`; None off the line.

        What is returned is kept as the start of the next refinement.
        """
        if not hasattr(initial.terms, "line_at"):
            return None
        self._call(
            "timed reference", timed_reference, self._reference, initial.terms, initial.begin, self._chassis,
            self._limits.speed_rad_s, STEP_S, self._found,
        )  # fmt: skip
        distance_m, facing, *_ = self._found.tolist()
        way_m = float(np.hypot(*np.diff(self._reference, axis=0).T).sum())
        problem, buffers = self._posed(initial, way_m), self._buffers
        assert buffers is not None
        if not self.is_compiled:
            # Off the line too, so that no compilation waits for the robot to reach it.
            self._call("refine", refine, problem, buffers, 0)
        if not (distance_m < max(LATERAL_PART * way_m, 0.02) and facing > FACING):
            self._last = None
            return None
        buffers.commands[: self.history] = initial.past
        plan = buffers.commands[self.history :]
        starts = [_resampled(nominal, step_s, 0.0)]
        if self._last is not None:
            starts.append(_resampled(self._last, STEP_S, (t0_ns - self._last_ns) * 1e-9))
        best, best_cost = None, math.inf
        for one in starts:
            plan[:] = one
            cost = self._call("refine", refine, problem, buffers, 0)
            if cost < best_cost:
                best, best_cost = plan.copy(), cost
        if best is None:
            self._last = None
            return None
        plan[:] = best
        cost = self._call("refine", refine, problem, buffers, ITERATIONS)
        found = plan.copy()
        if not (math.isfinite(cost) and np.isfinite(found).all()):
            self._last = None
            return None
        self._last, self._last_ns = found, t0_ns
        return found

    def _posed(self, initial: RefinementStart, way_m: float) -> Problem:
        self._start[:] = initial.start
        # The reference is relative to the task's origin.
        self._start[:2] = initial.begin[:2]
        self._before[:] = initial.before
        means = (
            None if initial.means is None else np.ascontiguousarray(initial.means[self._counted[: len(initial.means)]])
        )
        x_icr_m = abs(self._chassis.x_icr_m)
        end_weight = max(END_X_ICR * x_icr_m * STEPS / max(way_m, 1e-3), LEAST_END_WEIGHT)
        change = min(self._limits.acceleration_rad_s2 * STEP_S, 4.0 * self._limits.speed_rad_s)
        return Problem(
            self._start, float(initial.elapsed_s), np.array(initial.slide, np.float64), means, self._base,
            self._effects, self._series, self._weights, self.history, self._reference,
            float(self._limits.speed_rad_s), float(change), self._before, CHANGE_S * self._chassis.wheel_radius_m,
            self._found[3:], end_weight, x_icr_m,
        )  # fmt: skip

    def _call(self, name: str, kernel: Callable[..., object], *arguments: object) -> float:
        entry = self._compiled.get(name)
        if entry is None:
            entry = self._compiled[name] = compiled_for(kernel, *arguments)
        return entry(*arguments)


def _buffers(history: int, means: Array | None) -> Buffers:
    size = CHANNELS * STEPS
    return Buffers(
        commands=np.zeros((history + STEPS, CHANNELS)),
        tried=np.zeros((history + STEPS, CHANNELS)),
        states=np.zeros((STEPS + 1, STATE_COLUMNS)),
        moved=np.zeros((STEPS + 1, STATE_COLUMNS)),
        remembered=means,
        residuals=np.zeros(size + 1),
        slopes=np.zeros((size, size + 1)),
        normal=np.zeros((size, size)),
        inverse=np.zeros((size, size)),
        gradient=np.zeros(size),
        step=np.zeros(size),
        multipliers=np.zeros((2, 2 * size)),
    )


def _resampled(plan: Array, step_s: float, gap_s: float) -> Array:
    """Return a plan of another step, from `gap_s` behind its begin on, at the middles of the steps."""
    at = (gap_s + STEP_S * (np.arange(STEPS) + 0.5)) / step_s - 0.5
    rows = np.arange(len(plan))
    return np.column_stack([np.interp(at, rows, column) for column in plan.T])
