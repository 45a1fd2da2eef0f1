"""How much earlier or later than the wheels poses and commands are stamped, found before anything is fitted.

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
from disco_hw.log.drive import Commands, Poses, Wheels

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
    clearly better with it; of both the one with which it fits better. One stretch that is off looks like a jump to the
    others.
    """
    plain = PoseClock(pose_delay_s(wheels, poses, settings))
    if not poses.t_s.size:
        return plain
    middles, delays = _by_stretch(wheels, poses, settings)
    first, last = float(poses.t_s[0]), float(poses.t_s[-1])
    few = delays.size < settings.fewest_clock_stretches
    if few or middles[-1] - middles[0] < settings.least_clock_share * (last - first):
        return plain
    centred = (middles - 0.5 * (first + last)) / (last - first)
    slope, level = np.polyfit(centred, delays, 1)
    # The step that the stretches show best lies between two of them.
    steps = [
        (float(np.var(delays[:k]) * k + np.var(delays[k:]) * (delays.size - k)), k) for k in range(2, delays.size - 1)
    ]
    squares, place = min(steps)
    of_drift = float(((delays - level - slope * centred) ** 2).sum())
    most = float(((delays - delays.mean()) ** 2).sum()) / settings.clock_times_better
    drifting = PoseClock(plain.delay_s, 0.5 * (first + last), last - first, drift_s=float(slope))
    jump_s = float(np.median(delays[place:]) - np.median(delays[:place]))
    jumping = PoseClock(plain.delay_s, jump_s=jump_s, jump_at_s=float(0.5 * (middles[place - 1] + middles[place])))
    likely = sorted(((of_drift, drifting), (squares, jumping)), key=lambda one: one[0])
    sizes = [max(abs(clock.drift_s), abs(clock.jump_s)) for _, clock in likely]
    if likely[0][0] > most or sizes[0] < settings.least_clock_error_s:
        return plain
    best, least = plain, _misfit_at(wheels, poses, plain.delay_s, settings) - settings.least_clock_nats
    for (left, clock), size_s in zip(likely, sizes, strict=True):
        if left > most or size_s < settings.least_clock_error_s:
            break
        at_s = _instant(wheels, poses, settings, delays, place, clock.jump_at_s) if clock.jump_s else clock.jump_at_s
        tried = replace(clock, jump_at_s=at_s)
        even = tried.corrected(poses)
        delay_s = pose_delay_s(wheels, even, settings)
        misfit = _misfit_at(wheels, even, delay_s, settings)
        if misfit < least:
            best, least = replace(tried, delay_s=delay_s), misfit
    return best


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


def command_delay_s(wheels: Wheels, commands: Commands, settings: GridSettings) -> float | None:
    """How much later than its stamp a command is acted on at first sight, s: negative where it is stamped too late.

    Scanned as the poses' delay: what a wheel turns between samples `delay_span_s` apart is fitted by what both commands
    ask for, first without a lag, then with each of `lags_s`, as long in all. 0 where commands are too few or where no
    delay stands out; None where the longest delay or lag fits best, so that no other is known to be the one.
    """
    if min(wheels.t_s.size, commands.t_s.size) < 2:
        return 0.0
    # Held speeds may come less often.
    span_s = max(settings.delay_span_s, float(np.median(np.diff(wheels.t_s))))
    first, second = _apart(wheels.t_s, wheels.segment, span_s)
    if first.size < settings.fewest_poses:
        return 0.0
    every = max(first.size // settings.most_command_pairs, 1)
    first, second = first[::every], second[::every]
    pairs = wheels.t_s[first], wheels.t_s[second], wheels.segment[first]
    turned = [angle[second] - angle[first] for angle in (wheels.left_angle_rad, wheels.right_angle_rad)]
    steps = round(settings.most_pose_delay_s / settings.delay_step_s)
    delays: Array = settings.delay_step_s * np.arange(-steps, steps + 1, dtype=np.float64)
    misfit = _command_misfits(commands, pairs, turned, delays, 0.0, settings)
    ordinary = misfit[np.isfinite(misfit)]
    if not ordinary.size:
        return 0.0
    best, usual = int(np.argmin(misfit)), float(np.median(ordinary))
    found, least = float(delays[best] + settings.delay_step_s * _vertex(misfit, best)), float(misfit[best])
    within = 0 < best < delays.size - 1
    for lag_s in settings.lags_s:
        shorter = delays[np.abs(delays - (delays[best] - lag_s)) < settings.lag_reach_s]
        misfit = _command_misfits(commands, pairs, turned, shorter, lag_s, settings)
        if misfit.size and misfit.min() < least:
            place = int(np.argmin(misfit))
            found, least = float(shorter[place] + settings.delay_step_s * _vertex(misfit, place)), float(misfit[place])
            within = within and lag_s < max(settings.lags_s)
    if usual - least < settings.least_delay_nats:
        return 0.0
    return found if within else None


def _command_misfits(
    commands: Commands, pairs: tuple[Array, Array, Index], turned: list[Array], delays: Array, lag_s: float,
    settings: GridSettings,
) -> Array:  # fmt: skip
    """Minus the log likelihood per pair and wheel at each of some delays (D,) behind a lag; infinite for too few."""
    begin, end, segment = pairs
    asked = np.column_stack([commands.left_rad_s, commands.right_rad_s])
    unknown = np.isnan(asked[:, 0])
    state, angle = np.empty(asked.shape), np.empty(asked.shape)
    _answer(commands.t_s, np.nan_to_num(asked), lag_s, state, angle)
    lost = np.concatenate([[0.0], np.cumsum(np.diff(commands.t_s) * unknown[:-1])])
    misfit = np.full(delays.size, np.inf)
    for place, delay in enumerate(delays):
        ends, known = [], np.ones(begin.size, dtype=bool)
        for at in (begin - delay, end - delay):
            k = np.maximum(np.searchsorted(commands.t_s, at, side="right") - 1, 0)
            # Before the first command nothing is known, and is not counted below.
            since = np.maximum(at - commands.t_s[k], 0.0)[:, None]
            slow = lag_s * (1.0 - np.exp(-since / lag_s)) if lag_s > 0.0 else 0.0
            now = np.nan_to_num(asked[k])
            ends.append((angle[k] + now * since + (state[k] - now) * slow, lost[k] + since[:, 0] * unknown[k]))
            known &= (commands.segment[k] == segment) & (at >= commands.t_s[0]) & (at <= commands.t_s[-1])
        known &= ends[1][1] - ends[0][1] < 1e-9
        if np.count_nonzero(known) < settings.fewest_poses:
            continue
        moved = (ends[1][0] - ends[0][0])[known]
        difference, total = moved[:, 1] - moved[:, 0], moved[:, 1] + moved[:, 0]
        misfit[place] = sum(_misfit(difference, total, measured[known]) for measured in turned)
    return misfit


@kernel_function
def _answer(t_s: Array, asked: Array, lag_s: float, state: Array, angle: Array) -> None:
    """Speeds (N, 2) of wheels that follow commands with a lag at the instants of these, and the way turned by then."""
    for side in range(asked.shape[1]):
        state[0, side], angle[0, side] = asked[0, side], 0.0
        for k in range(1, t_s.shape[0]):
            step_s, before = t_s[k] - t_s[k - 1], asked[k - 1, side]
            left = math.exp(-step_s / lag_s) if lag_s > 0.0 else 0.0
            behind = state[k - 1, side] - before
            angle[k, side] = angle[k - 1, side] + before * step_s + behind * lag_s * (1.0 - left)
            state[k, side] = before + behind * left


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
    return _apart(poses.t_s, poses.segment, span_s)


def _apart(t_s: Array, segment: Index, span_s: float) -> tuple[Index, Index]:
    """Pairs of samples of one segment that lie `span_s` apart, or little more."""
    later = np.searchsorted(t_s, t_s + span_s - 1e-9)
    first = np.flatnonzero(later < t_s.size)
    second = later[first]
    near = (segment[first] == segment[second]) & (t_s[second] - t_s[first] < 1.6 * span_s)
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
