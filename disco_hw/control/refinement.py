"""Refinement of DISCO's plan beside the task's line: a few Gauss-Newton steps from the better of two plans.

Sampling is the global search and the fallback. Its plan and the last refined one are both costed against a reference
in time (`timed_reference`, or the task's own), in the mean of the belief; the cheaper one is improved
(`kernel/refine.py`). The mean it is because feedback corrects what a wrong parameter does, which a plan costed under
several points does not know: it leaves the line on the side where their spread costs least.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.backwards import task_of, turned_chassis, turned_start
from disco_hw.control.kernel import CARRIED_X, CARRIED_Y, START_COS, START_SIN, START_X, START_Y, Terms
from disco_hw.control.kernel.guide import SteeredChassis
from disco_hw.control.kernel.refine import CHANNELS, STATE_COLUMNS, Buffers, LateralLag, Problem, refine
from disco_hw.control.kernel.timed_reference import PARTS, SPEED_COLUMNS, timed_reference
from disco_hw.control.parameter_points import mean_point
from disco_hw.control.plan import CommandLimits, DiscoSettings
from disco_hw.control.state_prediction import PlanStart
from disco_hw.jit import compiled_for
from disco_hw.model import Model
from disco_hw.model.added_terms import new_means
from disco_hw.model.model import coefficient_tables
from disco_hw.model.step import integration_series
from disco_hw.tasks.line import SHARP_RAD
from disco_hw.tasks.line.course import SMALLEST_X_ICR_M, stable_yaw

Array = NDArray[np.float64]

# Chosen: more look further ahead, and each takes its share of the time. No more than the sampled plan has.
STEPS = 20
# Chosen: each takes its time of the tick; the next tick begins from what this one found.
ITERATIONS = 2
# A wheel's acceleration of 1 rad/s^2 costs as much as this distance, whatever the wheel's radius: the noise of poses,
# which restless commands answer, is alike for robots of all sizes.
ACCELERATION_M = 6e-4
# What lies beyond the horizon: who follows the line exactly with the tracked point behind the centre of rotation turns
# away from the heading that stays on it, e-fold over each x_icr of the way. So the end, distance and x_icr times the
# error of the heading, counts as much as over so many times x_icr more of the way. With the point ahead of the centre
# errors of the heading die away by themselves, and the end counts as every step does. Measured at 0.1 m/s on an eight:
# robots whose body slides late were 3.5 mm off with 5, 2.7 with 10, 2.3 with 20.
END_X_ICR = 20.0
# The robot is beside the line within this part of the way that the horizon covers, and facing within this cosine.
LATERAL_PART, FACING = 0.3, 0.5
# Plus so many times the drift within the horizon: sampled plans do not know of it, and stay that far from the line.
DRIFT_MARGIN = 2.0
# Behind a place that moves by itself it may be as far as that goes within the horizon: sampled plans do not catch up.
TIMED_PART = 1.0
# Length of the line beyond the horizon, in x_icr, and pieces of it, from which the heading against a drift is found.
BEYOND_X_ICR, BEYOND = 4.0, 12
# Two points of the line that are as near as this are one.
SMALLEST_WAY_M = 1e-4
# A robot that, in the mean over the last horizon, covers less than this part of its way is left to the sampled plan: a
# reference that starts anew beside the robot lets a plan put off its way from tick to tick. And one that starts from
# rest would be turned on the spot to where the line begins, as fast as its wheels can.
LEAST_PROGRESS = 0.25


class Refinement:
    """Improves plans for robots beside their line; keeps its last plan as the start of the next."""

    def __init__(self, limits: CommandLimits, settings: DiscoSettings, history: int) -> None:
        """Refine within the limits, in the steps of `settings`, after `history` commands from before the plan."""
        self._limits, self._step_s, self._history = limits, settings.step_s, history
        self._backwards, self._turn_ahead_m = settings.backwards, settings.turn_ahead_m
        self._rows = np.arange(min(STEPS, settings.sampler.horizon))
        self._series = integration_series(settings.step_s, wide=True)
        self._reference = np.zeros((self._rows.size, CHANNELS), np.float32)
        self._found = np.ones(6, np.float32)
        self._speeds = np.zeros((PARTS * self._rows.size, SPEED_COLUMNS), np.float32)
        self._beyond = np.zeros((BEYOND + 1, CHANNELS), np.float32)
        self._start, self._before = np.zeros(5), np.zeros(CHANNELS)
        self._compiled: dict[str, Callable[..., float]] = {}
        self._last: Array | None = None
        self._last_ns = 0
        self._progress = CoveredWay(self._horizon_s)
        self._buffers: Buffers | None = None

    @property
    def _horizon_s(self) -> float:
        return self._rows.size * self._step_s

    @property
    def _ahead(self) -> float:
        """Sign of the speed at which the robot follows the line."""
        return -1.0 if self._backwards else 1.0

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
        self._progress.reset()

    def set_model(self, model: Model, chassis: SteeredChassis) -> None:
        """Refine in the mean of this model's belief from now on."""
        self._chassis = turned_chassis(chassis) if self._backwards else chassis
        self._base, self._effects = coefficient_tables(model, mean_point(model), self._step_s)
        if self._buffers is None:
            self._buffers = create_buffers(self._rows.size, self._history, new_means(self._effects))

    def improve(self, terms: Terms, start: NDArray[np.float32], begin: PlanStart, nominal: Array) -> Array | None:
        """Return commands (N, 2) that cost no more than the plan `nominal` (T, 2); None off the line.

        `terms` of the task and `start` (10,) are those of `SkidSteer`.
        What is returned is kept as the start of the next refinement.
        """
        task = task_of(terms)
        is_timed = hasattr(task, "headings")
        if not (is_timed or hasattr(task, "line_at")):
            return None
        # The reference, and what is found on the line, are those of the robot as the task sees it.
        moves = self._set_reference(task, turned_start(start) if self._backwards else start)
        distance_m, facing, _, _, _, way_m = self._found.tolist()
        problem, buffers = self._posed(begin, start, way_m), self._buffers
        assert buffers is not None
        if not self.is_compiled:
            # Off the line too, so that no compilation waits for the robot to reach it.
            self._call("refine", refine, problem, buffers, 0, 0)
        last, self._last = self._last, None
        forward_rad_s = self._ahead * 0.5 * float(begin.state[3] + begin.state[4])
        covered_m = forward_rad_s * self._chassis.wheel_radius_m * self._horizon_s
        progress = self._progress.after(begin.t0_ns, covered_m / max(way_m, 1e-3))
        part = TIMED_PART if is_timed else LATERAL_PART
        carried_m = DRIFT_MARGIN * self._rows.size * math.hypot(start[CARRIED_X], start[CARRIED_Y])
        is_beside = distance_m < max(part * way_m, 0.02) + carried_m and facing > FACING
        if not moves or progress < LEAST_PROGRESS or not is_beside:
            return None
        buffers.commands[: self._history] = begin.earlier
        buffers.starts[0] = nominal[: self._rows.size]
        if last is not None:
            shifted = self._rows + (begin.t0_ns - self._last_ns) * 1e-9 / self._step_s
            buffers.starts[1] = np.column_stack([np.interp(shifted, self._rows, column) for column in last.T])
        cost = self._call("refine", refine, problem, buffers, 1 if last is None else 2, ITERATIONS)
        if not math.isfinite(cost):
            return None
        self._last, self._last_ns = buffers.commands[self._history :].copy(), begin.t0_ns
        return self._last

    def _set_reference(self, terms: Terms, start: NDArray[np.float32]) -> bool:
        """Set the reference, and what else is found on the task's line; returns whether it goes anywhere."""
        carried_m = complex(start[CARRIED_X], start[CARRIED_Y])
        x_icr_m = self._chassis.x_icr_m
        if hasattr(terms, "line_at"):
            self._call(
                "timed reference", timed_reference, self._reference, terms, start, self._chassis,
                self._limits.speed_rad_s, self._limits.acceleration_rad_s2, self._step_s, self._turn_ahead_m,
                self._speeds, self._found, self._beyond, BEYOND_X_ICR / BEYOND * x_icr_m,
            )  # fmt: skip
            if carried_m and x_icr_m > SMALLEST_X_ICR_M:
                last_m = math.dist(*self._reference[-2:].tolist())
                rotation = drift_correction(self._beyond, last_m, carried_m, x_icr_m)
                turned = complex(*self._found[3:5].tolist()) * rotation
                self._found[3:5] = turned.real, turned.imag
            return True
        # The task is a reference in time, and its origin is where the robot should be now.
        headings = terms.headings(x_icr_m, carried_m)
        self._reference[:, 0], self._reference[:, 1] = terms.x[: self._rows.size], terms.y[: self._rows.size]
        if headings is None:
            return False
        first, last = headings[0], headings[self._rows.size]
        facing = math.cos(first) * start[START_COS] + math.sin(first) * start[START_SIN]
        way_m = np.hypot(*np.diff(self._reference, axis=0).T).sum()
        self._found[:] = math.hypot(start[START_X], start[START_Y]), facing, 1.0, math.cos(last), math.sin(last), way_m
        return True

    def _posed(self, begin: PlanStart, start: NDArray[np.float32], way_m: float) -> Problem:
        self._start[:] = begin.state
        # The reference is relative to the task's origin.
        self._start[:2] = start[:2]
        self._before[:] = begin.before
        behind_m = max(self._chassis.x_icr_m, 0.0)
        end_weight = max(END_X_ICR * behind_m * self._rows.size / max(way_m, 1e-3), 1.0)
        change_m = ACCELERATION_M / self._step_s
        change = min(self._limits.acceleration_rad_s2 * self._step_s, 4.0 * self._limits.speed_rad_s)
        # Measured: with the point ahead of the centre, plans that count on the lag pass corners 0.3 mm further away.
        lateral = LateralLag.of(begin.lateral_lag_s if behind_m > 0.0 else 0.0, self._step_s)
        return Problem(
            self._start, float(begin.elapsed_s), np.array(begin.drift, np.float64), lateral, begin.mean_means,
            self._base, self._effects, self._series, self._history, self._reference,
            float(self._limits.speed_rad_s), float(change), self._before, change_m,
            self._ahead * self._found[3:5], end_weight, behind_m,
        )  # fmt: skip

    def _call(self, name: str, kernel: Callable[..., object], *arguments: object) -> float:
        entry = self._compiled.get(name)
        if entry is None:
            entry = self._compiled[name] = compiled_for(kernel, *arguments)
        return entry(*arguments)


def drift_correction(line_m: NDArray[np.float32], step_m: float, carried_m: complex, x_icr_m: float) -> complex:
    """Return the rotation of the heading at the start of a line that compensates a drift, a unit complex number.

    `line_m` (N, 2): points of the line. While the robot covers `step_m` of it the ground carries it by `carried_m`
    (x + i y). Its own motion is the difference, and its heading the stable one along that (`stable_yaw`). A drift of
    more than half the robot's speed, as where it slows down to stop, counts as half.
    """
    ways = np.diff(line_m.astype(np.float64) @ (1.0, 1j))
    lengths_m = np.abs(ways)
    turns_rad = np.abs(np.angle(ways[1:] * ways[:-1].conj()))
    # As in the task's table, what comes behind the line's end or a sharp turn says nothing of the heading before.
    ends = np.flatnonzero((lengths_m[1:] < SMALLEST_WAY_M) | (turns_rad > SHARP_RAD))
    count = ends[0] + 1 if ends.size else ways.size
    ways, lengths_m = ways[:count], lengths_m[:count]
    if min(lengths_m[0], step_m) < SMALLEST_WAY_M:
        return 1.0
    own = ways - carried_m * lengths_m / max(step_m, 2.0 * abs(carried_m))
    with_ground, without = (
        stable_yaw(np.unwrap(np.angle(one)), np.abs(one), x_icr_m, closed=False)[0] for one in (own, ways)
    )
    return cmath.rect(1.0, with_ground - without)


class CoveredWay:
    """The part of the way along the line that the robot covers, as a mean over about `horizon_s`."""

    def __init__(self, horizon_s: float) -> None:
        self._horizon_s = horizon_s
        self._part: float | None = None
        self._ns = 0

    def reset(self) -> None:
        """Begin with what the robot covers at the next call."""
        self._part = None

    def after(self, now_ns: int, part: float) -> float:
        """Return the mean at `now_ns`, of a robot that now covers this part."""
        covered = min(max(part, 0.0), 1.0)
        weight = 1.0 if self._part is None else min((now_ns - self._ns) * 1e-9 / self._horizon_s, 1.0)
        self._part, self._ns = (self._part or 0.0) + weight * (covered - (self._part or 0.0)), now_ns
        return self._part


def create_buffers(steps: int, history: int, means: Array | None) -> Buffers:
    """Return scratch for so many steps after `history` rows, for a model that remembers `means` (n,) or nothing."""
    size = CHANNELS * steps
    return Buffers(
        commands=np.zeros((history + steps, CHANNELS)),
        tried=np.zeros((history + steps, CHANNELS)),
        starts=np.zeros((2, steps, CHANNELS)),
        states=np.zeros((steps + 1, STATE_COLUMNS)),
        moved=np.zeros((steps + 1, STATE_COLUMNS)),
        remembered=means,
        residuals=np.zeros(size + 1),
        slopes=np.zeros((size, size + 1)),
        normal=np.zeros((size, size)),
        inverse=np.zeros((size, size)),
        gradient=np.zeros(size),
        step=np.zeros(size),
        multipliers=np.zeros((2, 2 * size)),
    )
