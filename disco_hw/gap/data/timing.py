"""How much earlier or later than the wheels the poses are stamped, found from the log alone before anything is fitted.

A search that begins without a delay of 0.3 s does not find it: it takes what the delay makes for slip and noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.settings import GridSettings
from disco_hw.jit import kernel_function, scalar_function
from disco_hw.log.drive import Poses, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDS = 4
# Finer than any pose is measured; keeps a log without any noise finite.
_LEAST_SQUARE = 1e-10
# A column of which the other one leaves less than this share of its square says nothing of its own.
_LEAST_OWN = 1e-12


@dataclass(frozen=True, slots=True)
class PoseClock:
    """How the poses' clock runs against the wheels': `delay_s` is how much older than its stamp a pose is mid-log.

    Over the log the delay grows by `drift_s` on the whole, or by `jump_s` at once at `jump_at_s`; both 0 as a rule.
    """

    delay_s: float
    middle_s: float = 0.0
    span_s: float = 1.0
    drift_s: float = 0.0
    jump_s: float = 0.0
    jump_at_s: float = 0.0

    def off_s(self, t_s: Array) -> Array:
        """How much more than by `delay_s` poses stamped so are older."""
        drift = self.drift_s * (t_s - self.middle_s) / self.span_s
        return np.asarray(drift + self.jump_s * ((t_s >= self.jump_at_s) - 0.5))

    def corrected(self, poses: Poses) -> Poses:
        """Poses with stamps of an even clock; those that a jump makes come before an earlier one are left out."""
        t_s = poses.t_s - self.off_s(poses.t_s)
        keep = t_s > np.concatenate([[-np.inf], np.maximum.accumulate(t_s)[:-1]])
        return Poses(t_s[keep], poses.x_m[keep], poses.y_m[keep], poses.yaw_rad[keep], poses.segment[keep])

    @property
    def notes(self) -> tuple[str, ...]:
        """What a person has to know of it."""
        if self.drift_s:
            per_s = 1e3 * self.drift_s / self.span_s
            return (
                f"the poses' clock drifts against the wheels' by {per_s:+.2f} ms every second, "
                f"{1e3 * self.drift_s:+.0f} ms over the log: their stamps are corrected; synchronise the clocks",
            )
        if self.jump_s:
            return (
                f"the poses' clock jumps against the wheels' by {1e3 * self.jump_s:+.0f} ms at {self.jump_at_s:.0f} s: "
                "their stamps are corrected; synchronise the clocks",
            )
        return ()


def pose_clock(wheels: Wheels, poses: Poses, settings: GridSettings) -> PoseClock:
    """Delay of the poses against the wheels, and whether it drifts or jumps, from stretches looked at one by one.

    A drift or a jump is believed where the stretches agree on it far beyond their scatter, and where the whole log fits
    clearly better with it.
    """
    plain = PoseClock(pose_delay_s(wheels, poses, settings))
    if not poses.t_s.size:
        return plain
    middles, delays = _by_stretch(wheels, poses, settings)
    if delays.size < settings.fewest_clock_stretches:
        return plain
    first, last = float(poses.t_s[0]), float(poses.t_s[-1])
    centred = (middles - 0.5 * (first + last)) / (last - first)
    slope, level = np.polyfit(centred, delays, 1)
    # The step that the stretches show best lies between two of them.
    steps = [
        (float(np.var(delays[:k]) * k + np.var(delays[k:]) * (delays.size - k)), k) for k in range(2, delays.size - 1)
    ]
    squares, place = min(steps)
    of_drift = float(((delays - level - slope * centred) ** 2).sum())
    constant = float(((delays - delays.mean()) ** 2).sum())
    least = min(of_drift, squares)
    if constant < settings.clock_times_better * least:
        return plain
    if of_drift <= squares:
        clock = PoseClock(plain.delay_s, 0.5 * (first + last), last - first, drift_s=float(slope))
        size_s = abs(slope)
    else:
        jump_s = float(np.median(delays[place:]) - np.median(delays[:place]))
        at_s = float(0.5 * (middles[place - 1] + middles[place]))
        clock = PoseClock(
            plain.delay_s, jump_s=jump_s, jump_at_s=_instant(wheels, poses, settings, delays, place, at_s)
        )
        size_s = abs(jump_s)
    if size_s < settings.least_clock_error_s:
        return plain
    even = clock.corrected(poses)
    delay_s = pose_delay_s(wheels, even, settings)
    gained = _misfit_at(wheels, poses, plain.delay_s, settings) - _misfit_at(wheels, even, delay_s, settings)
    return replace(clock, delay_s=delay_s) if gained > settings.least_clock_nats else plain


def _by_stretch(wheels: Wheels, poses: Poses, settings: GridSettings) -> tuple[Array, Array]:
    """Middles of stretches of `clock_stretch_s`, and the delay of the poses of each that shows one."""
    count = max(int((poses.t_s[-1] - poses.t_s[0]) / settings.clock_stretch_s), 1)
    edges = np.linspace(poses.t_s[0], poses.t_s[-1] + 1e-6, count + 1)
    middles, delays = [], []
    for low, high in pairwise(edges):
        delay_s = pose_delay_s(wheels, _part(poses, (poses.t_s >= low) & (poses.t_s < high)), settings)
        if delay_s != 0.0:
            middles.append(0.5 * (low + high))
            delays.append(delay_s)
    return np.array(middles), np.array(delays)


def _part(poses: Poses, chosen: NDArray[np.bool_]) -> Poses:
    return Poses(poses.t_s[chosen], poses.x_m[chosen], poses.y_m[chosen], poses.yaw_rad[chosen], poses.segment[chosen])


def _instant(wheels: Wheels, poses: Poses, settings: GridSettings, delays: Array, place: int, about_s: float) -> float:
    """When a jump between two stretches happened, to a second: where both sides together fit best."""
    sides = float(np.median(delays[:place])), float(np.median(delays[place:]))
    reach = np.arange(about_s - settings.clock_stretch_s, about_s + settings.clock_stretch_s, 1.0)
    costs = []
    for at_s in reach:
        parts = [(_part(poses, poses.t_s < at_s), sides[0]), (_part(poses, poses.t_s >= at_s), sides[1])]
        costs.append(sum(part.t_s.size * _misfit_at(wheels, part, delay_s, settings) for part, delay_s in parts))
    return float(reach[int(np.argmin(costs))])


def pose_delay_s(wheels: Wheels, poses: Poses, settings: GridSettings) -> float:
    """The delay at which poses and wheels agree best, s: positive where a pose is older than its time stamp.

    Scanned over +-`most_pose_delay_s`: for each delay the turns and ways between poses `delay_span_s` apart are fitted
    by those of the wheels (two regressions, robust by Huber's weights; their likelihoods, with unknown variances, are
    added). 0 where the poses are too few or where no delay stands out.
    """
    steps = round(settings.most_pose_delay_s / settings.delay_step_s)
    delays: Array = settings.delay_step_s * np.arange(-steps, steps + 1, dtype=np.float64)
    misfit = _misfits(wheels, poses, delays, settings)
    best = int(np.argmin(misfit))
    ordinary = misfit[np.isfinite(misfit)]
    if not ordinary.size or float(np.median(ordinary)) - misfit[best] < settings.least_delay_nats:
        return 0.0
    return float(delays[best] + settings.delay_step_s * _vertex(misfit, best))


def _misfit_at(wheels: Wheels, poses: Poses, delay_s: float, settings: GridSettings) -> float:
    """Minus the log likelihood per pose at a delay; 0 where the poses are too few."""
    misfit = float(_misfits(wheels, poses, np.full(1, delay_s), settings)[0])
    return misfit if np.isfinite(misfit) else 0.0


def _misfits(wheels: Wheels, poses: Poses, delays: Array, settings: GridSettings) -> Array:
    """Minus the log likelihood per pose at each of some delays (D,); infinite where the poses are too few."""
    misfit = np.full(delays.size, np.inf)
    before, after = _pairs(poses, settings.delay_span_s)
    turn = np.remainder(poses.yaw_rad[after] - poses.yaw_rad[before] + np.pi, 2.0 * np.pi) - np.pi
    heading = poses.yaw_rad[before] + 0.5 * turn
    way = (poses.x_m[after] - poses.x_m[before]) * np.cos(heading)
    way += (poses.y_m[after] - poses.y_m[before]) * np.sin(heading)
    begin, end = _bounds(wheels, poses.segment[before])
    for place, delay in enumerate(delays):
        t_s = poses.t_s - delay
        known = (t_s[before] >= begin) & (t_s[after] <= end)
        if np.count_nonzero(known) < settings.fewest_poses:
            continue
        first, last = before[known], after[known]
        left, right = (
            at[last] - at[first]
            for at in (np.interp(t_s, wheels.t_s, angle) for angle in (wheels.left_angle_rad, wheels.right_angle_rad))
        )
        difference, total = right - left, right + left
        misfit[place] = sum(_misfit(difference, total, measured[known]) for measured in (turn, way))
    return misfit


def _pairs(poses: Poses, span_s: float) -> tuple[Index, Index]:
    """Pairs of poses of one segment that lie `span_s` apart, or little more."""
    later = np.searchsorted(poses.t_s, poses.t_s + span_s - 1e-9)
    first = np.flatnonzero(later < poses.t_s.size)
    second = later[first]
    near = (poses.segment[first] == poses.segment[second]) & (poses.t_s[second] - poses.t_s[first] < 1.6 * span_s)
    return first[near], second[near]


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


@scalar_function
def _projected(aa: float, ab: float, bb: float, ay: float, by: float) -> tuple[float, float]:
    """Coefficients of two columns by normal equations, `aa` not the smaller; of the second 0 where they are alike."""
    if aa == 0.0:
        return 0.0, 0.0
    own = bb - ab * ab / aa
    second = (by - ab * ay / aa) / own if own > _LEAST_OWN * bb else 0.0
    return (ay - ab * second) / aa, second


@kernel_function
def _misfit(difference: Array, total: Array, measured: Array) -> float:
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
            of_a, of_b = _projected(aa, ab, bb, ay, by)
        else:
            of_b, of_a = _projected(bb, ab, aa, by, ay)
        for k in range(count):
            left[k] = abs(measured[k] - of_a * difference[k] - of_b * total[k])
        limit = 2.0 * 1.4826 * np.median(left) + 1e-9
    loss = 0.0
    for k in range(count):
        loss += left[k] * left[k] if left[k] < limit else limit * (2.0 * left[k] - limit)
    return 0.5 * math.log(loss / count + _LEAST_SQUARE)


def _vertex(values: Array, least: int) -> float:
    """Where the parabola through the least of some values and its neighbours has its vertex, in places from it."""
    if not 0 < least < values.size - 1 or not np.isfinite(values[least - 1 : least + 2]).all():
        return 0.0
    low, mid, high = values[least - 1 : least + 2]
    bend = low - 2.0 * mid + high
    return float(0.5 * (low - high) / bend) if bend > 0.0 else 0.0
