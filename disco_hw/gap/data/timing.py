"""Delay of the poses against the wheels, estimated before any other fit.

A search that begins without a delay of 0.3 s does not find it: it takes its traces for slip and noise. All searches
for a delay share the code below: pairs of samples, a robust regression on both wheels, the least of a scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from disco_hw.gap.data.stamp_clock import StampClock, between, clock_of
from disco_hw.gap.settings import OF_MEDIAN, GridSettings
from disco_hw.jit import kernel_function, scalar_function
from disco_hw.log.drive import Poses, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Chosen: each round reweights the outliers anew, and takes as long.
_ROUNDS = 4
# Finer than any pose is measured; keeps a log without any noise finite.
_LEAST_SQUARE = 1e-10
# A column of which the other one leaves less than this share of its square says nothing of its own.
_LEAST_INDEPENDENT = 1e-12
# Stamps are alike to the microsecond.
_STAMP_DIGITS = 6
# So closely the least of a misfit is searched: a hundredth of what a cell of the grid holds.
_CLOSE_S = 1e-4


@dataclass(frozen=True, slots=True)
class PoseAlignment:
    """Poses beside the wheels, as their clock is sought."""

    wheels: Wheels
    poses: Poses
    settings: GridSettings

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of the first and of the last pose."""
        t_s = self.poses.t_s
        return (float(t_s[0]), float(t_s[-1])) if t_s.size else (0.0, 0.0)

    @property
    def stretch_s(self) -> float:
        """Length of the stretches that are looked at one by one."""
        return self.settings.clock_stretch_s

    def fitted(self, clock: StampClock) -> tuple[float, float]:
        """Age of all poses, their stamps corrected by a clock, and the misfit of a pose."""
        even = clock.corrected(self.poses)
        delay_s = pose_delay_s(self.wheels, even, self.settings)
        return delay_s, _mismatch_at(self.wheels, even, delay_s, self.settings)

    def part_delay_s(self, low_s: float, high_s: float) -> float | None:
        """Age of the poses of a stretch; None where it does not show."""
        return pose_delay_s(self.wheels, between(self.poses, low_s, high_s), self.settings) or None

    def part_mismatch(self, low_s: float, high_s: float, delay_s: float) -> float:
        """Misfit of all poses of a stretch at an age."""
        part = between(self.poses, low_s, high_s)
        return part.t_s.size * _mismatch_at(self.wheels, part, delay_s, self.settings)


def pose_clock(wheels: Wheels, poses: Poses, settings: GridSettings) -> StampClock:
    """Delay of the poses against the wheels, and whether it drifts or jumps."""
    align = PoseAlignment(wheels, poses, settings)
    return clock_of(align, settings, settings.least_clock_error_s, settings.least_clock_nats)


def pose_delay_s(wheels: Wheels, poses: Poses, settings: GridSettings) -> float:
    """Estimate the delay (s) at which poses and wheels agree best: positive where poses are older than their stamps.

    Scanned over +-`most_pose_delay_s`: for each delay the turns and ways between poses `delay_span_s` apart are fitted
    by those of the wheels (two regressions, robust by Huber's weights; their likelihoods, with unknown variances, are
    added). 0 where the poses are too few or where no delay stands out.
    """
    found_s = most_distinct_delay(
        lambda some: _mismatches(wheels, poses, some, settings), settings.delay_step_s, settings
    )
    return found_s or 0.0


def tick_s(t_s: Array, rows_s: Array) -> float:
    """Time between the rows of a log, s, where samples (n,) are stamped as these (R,); 0 where they have own stamps.

    What a row holds was so at some time since the row before: when is not known.
    """
    if not t_s.size or rows_s.size < 2:
        return 0.0
    shared = np.isin(np.round(t_s, _STAMP_DIGITS), np.round(rows_s, _STAMP_DIGITS))
    return float(np.median(np.diff(rows_s))) if shared.all() else 0.0


def _mismatch_at(wheels: Wheels, poses: Poses, delay_s: float, settings: GridSettings) -> float:
    """Minus the log likelihood per pose at a delay; 0 where the poses are too few."""
    mismatch = float(_mismatches(wheels, poses, np.full(1, delay_s), settings)[0])
    return mismatch if np.isfinite(mismatch) else 0.0


def _mismatches(wheels: Wheels, poses: Poses, delays: Array, settings: GridSettings) -> Array:
    """Minus the log likelihood per pose at each of some delays (D,); infinite where the poses are too few."""
    mismatch = np.full(delays.size, np.inf)
    before, after = apart(poses.t_s, poses.segment, settings.delay_span_s)
    turn = np.remainder(poses.yaw_rad[after] - poses.yaw_rad[before] + np.pi, 2.0 * np.pi) - np.pi
    heading = poses.yaw_rad[before] + 0.5 * turn
    way = (poses.x_m[after] - poses.x_m[before]) * np.cos(heading)
    way += (poses.y_m[after] - poses.y_m[before]) * np.sin(heading)
    begin, end = _bounds(wheels, poses.segment[before])
    for place, delay in enumerate(delays):
        t_s = poses.t_s - delay
        known = (t_s[before] >= begin) & (t_s[after] <= end)
        if np.count_nonzero(known) < settings.fewest_samples:
            continue
        first, last = before[known], after[known]
        left, right = (
            at[last] - at[first]
            for at in (np.interp(t_s, wheels.t_s, angle) for angle in (wheels.left_angle_rad, wheels.right_angle_rad))
        )
        difference, total = right - left, right + left
        mismatch[place] = sum(mismatch_of(difference, total, measured[known]) for measured in (turn, way))
    return mismatch


def _bounds(wheels: Wheels, segment: Index) -> tuple[Array, Array]:
    """First and last time of the wheels' samples in some segments; an empty span where there are none."""
    segments = np.unique(segment)
    begin, end = np.full(segments.size, np.inf), np.full(segments.size, -np.inf)
    for place, number in enumerate(segments):
        times = wheels.t_s[wheels.segment == number]
        if times.size:
            begin[place], end[place] = times[0], times[-1]
    at = np.searchsorted(segments, segment)
    return begin[at], end[at]


def apart(t_s: Array, segment: Index, span_s: float) -> tuple[Index, Index]:
    """Pairs of samples of one segment that lie `span_s` apart, or little more."""
    later = np.searchsorted(t_s, t_s + span_s - 1e-9)
    first = np.flatnonzero(later < t_s.size)
    second = later[first]
    near = (segment[first] == segment[second]) & (t_s[second] - t_s[first] < 1.6 * span_s)
    return first[near], second[near]


def scanned_delays(most_s: float, step_s: float) -> Array:
    """Delays from minus the most to the most, (D,)."""
    steps = round(most_s / step_s)
    return np.asarray(step_s * np.arange(-steps, steps + 1, dtype=np.float64))


def most_distinct_delay(mismatches: Callable[[Array], Array], step_s: float, settings: GridSettings) -> float | None:
    """Return the delay (s) of the least mismatch, of all that are scanned in such steps; None if none stands out."""
    delays = scanned_delays(settings.most_pose_delay_s, step_s)
    mismatch = mismatches(delays)
    best, ordinary = int(np.argmin(mismatch)), mismatch[np.isfinite(mismatch)]
    if not ordinary.size or float(np.median(ordinary)) - mismatch[best] < settings.least_delay_nats:
        return None
    return lowest(mismatches, float(delays[best]), step_s)[0]


def lowest(mismatches: Callable[[Array], Array], about_s: float, step_s: float) -> tuple[float, float]:
    """Return the delay (s) of the least mismatch, within a step of a scan's best one, and the mismatch there."""

    def at(delay_s: float) -> float:
        return min(float(mismatches(np.full(1, delay_s))[0]), 1e3)

    bounds = (about_s - step_s, about_s + step_s)
    found = minimize_scalar(at, bounds=bounds, method="bounded", options={"xatol": _CLOSE_S})
    return float(found.x), float(found.fun)


@scalar_function
def projected(aa: float, ab: float, bb: float, ay: float, by: float) -> tuple[float, float]:
    """Coefficients of two columns by normal equations, `aa` not the smaller; of the second 0 where they are alike."""
    if aa == 0.0:
        return 0.0, 0.0
    independent = bb - ab * ab / aa
    second = (by - ab * ay / aa) / independent if independent > _LEAST_INDEPENDENT * bb else 0.0
    return (ay - ab * second) / aa, second


@kernel_function
def mismatch_of(difference: Array, total: Array, measured: Array) -> float:
    """Minus the log likelihood per sample of a robust regression on two columns (n,) whose variance is unknown."""
    count = measured.shape[0]
    left = np.zeros(count)
    limit = math.inf
    for _ in range(_ROUNDS):
        aa = ab = bb = ay = by = 0.0
        for k in range(count):
            a, b, y = difference[k], total[k], measured[k]
            weight = min(1.0, limit / max(left[k], 1e-12))
            aa += weight * a * a
            ab += weight * a * b
            bb += weight * b * b
            ay += weight * a * y
            by += weight * b * y
        if aa >= bb:
            of_a, of_b = projected(aa, ab, bb, ay, by)
        else:
            of_b, of_a = projected(bb, ab, aa, by, ay)
        for k in range(count):
            left[k] = abs(measured[k] - of_a * difference[k] - of_b * total[k])
        limit = 2.0 * OF_MEDIAN * np.median(left) + 1e-9
    loss = 0.0
    for k in range(count):
        loss += left[k] * left[k] if left[k] < limit else limit * (2.0 * left[k] - limit)
    return 0.5 * math.log(loss / count + _LEAST_SQUARE)
