"""Refinement of DISCO's plan beside the task's line: a few Gauss-Newton steps from the better of two plans.

Sampling is the global search and the fallback. Its plan and the last refined one are both costed against a timed
reference (`kernel/reference.py`), in the mean of the belief; the cheaper one is improved (`kernel/refine.py`). The mean
it is because feedback corrects what a wrong parameter does, which a plan costed under several points does not know: it
leaves the line on the side where their spread costs least.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import Terms
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.kernel.reference import timed_reference
from disco_hw.control.kernel.refine import CHANNELS, STATE_COLUMNS, Buffers, Problem, refine
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.plan import CommandLimits
from disco_hw.control.state_prediction import PlanStart
from disco_hw.jit import compiled_for
from disco_hw.model import Model
from disco_hw.model.added_terms import new_means
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import integration_series

Array = NDArray[np.float64]

# Chosen: more look further ahead, and each takes its share of the time.
STEPS = 20
ROWS = np.arange(STEPS)
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


class Refinement:
    """Improves plans for robots beside their line; keeps its last plan as the start of the next."""

    def __init__(self, limits: CommandLimits, step_s: float, history: int) -> None:
        """Refine within the limits, in steps of `step_s`, after `history` commands from before the plan."""
        self._limits, self._step_s, self._history = limits, step_s, history
        self._series = integration_series(step_s, wide=True)
        self._reference = np.zeros((STEPS, CHANNELS), np.float32)
        self._found = np.ones(6, np.float32)
        self._start, self._before = np.zeros(5), np.zeros(CHANNELS)
        self._compiled: dict[str, Callable[..., float]] = {}
        self._last: Array | None = None
        self._last_ns = 0
        self._buffers: Buffers | None = None

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

    def set_model(self, model: Model, chassis: SteeredChassis) -> None:
        """Refine in the mean of this model's belief from now on."""
        self._chassis = chassis
        self._base, self._effects = coefficient_tables(model, mean_point(model), self._step_s)
        if self._buffers is None:
            self._buffers = _buffers(self._history, new_means(self._effects))

    def improve(self, terms: Terms, start: NDArray[np.float32], begin: PlanStart, nominal: Array) -> Array | None:
        """Return commands (STEPS, 2) that cost no more than the plan `nominal` (T, 2); None off the line.

        `terms` of the task and `start` (11,) are those of `SkidSteer`.
        What is returned is kept as the start of the next refinement.
        """
        if not hasattr(terms, "line_at"):
            return None
        self._call(
            "timed reference", timed_reference, self._reference, terms, start, self._chassis,
            self._limits.speed_rad_s, self._step_s, self._found,
        )  # fmt: skip
        distance_m, facing, _, _, _, way_m = self._found.tolist()
        problem, buffers = self._posed(begin, start, way_m), self._buffers
        assert buffers is not None
        if not self.is_compiled:
            # Off the line too, so that no compilation waits for the robot to reach it.
            self._call("refine", refine, problem, buffers, 0, 0)
        last, self._last = self._last, None
        if not (distance_m < max(LATERAL_PART * way_m, 0.02) and facing > FACING):
            return None
        buffers.commands[: self._history] = begin.earlier
        buffers.starts[0] = nominal.take(ROWS, axis=0, mode="clip")
        if last is not None:
            buffers.starts[1] = _shifted(last, (begin.t0_ns - self._last_ns) * 1e-9 / self._step_s)
        cost = self._call("refine", refine, problem, buffers, 1 if last is None else 2, ITERATIONS)
        if not math.isfinite(cost):
            return None
        self._last, self._last_ns = buffers.commands[self._history :].copy(), begin.t0_ns
        return self._last

    def _posed(self, begin: PlanStart, start: NDArray[np.float32], way_m: float) -> Problem:
        self._start[:] = begin.state
        # The reference is relative to the task's origin.
        self._start[:2] = start[:2]
        self._before[:] = begin.before
        x_icr_m = abs(self._chassis.x_icr_m)
        end_weight = max(END_X_ICR * x_icr_m * STEPS / max(way_m, 1e-3), LEAST_END_WEIGHT)
        change_m = CHANGE_S * self._chassis.wheel_radius_m
        change = min(self._limits.acceleration_rad_s2 * self._step_s, 4.0 * self._limits.speed_rad_s)
        return Problem(
            self._start, float(begin.elapsed_s), np.array(begin.slide, np.float64), begin.mean_means, self._base,
            self._effects, self._series, self._history, self._reference,
            float(self._limits.speed_rad_s), float(change), self._before, change_m,
            self._found[3:5], end_weight, x_icr_m,
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
        starts=np.zeros((2, STEPS, CHANNELS)),
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


def _shifted(plan: Array, steps: float) -> Array:
    """Return a plan (STEPS, 2) moved on by so many steps, or parts of one."""
    return np.column_stack([np.interp(steps + ROWS, ROWS, column) for column in plan.T])
