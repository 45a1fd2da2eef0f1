"""Clock of time stamps against that of the wheels: it runs evenly, drifts, or jumps.

Logs that are searched together have a clock each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands, Poses, Wheels

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Array = NDArray[np.float64]
Samples = TypeVar("Samples", Commands, Poses)
Stamped = TypeVar("Stamped", Commands, Poses, Wheels)
Columns = TypeVar("Columns", bound="DataclassInstance")

# Chosen: those of half an hour; memory and time grow with their cube. Of a clock that drifts by 2 s, the most that is
# plausible, each holds 13 ms.
_MOST_STRETCHES = 150


class Alignment(Protocol):
    """Samples beside the wheels: how old they are, all of them and in parts of the log (s), and how well that fits."""

    @property
    def span_s(self) -> tuple[float, float]:
        """Stamps of the first and of the last sample."""

    @property
    def stretch_s(self) -> float:
        """Length of the stretches that are looked at one by one."""

    def fitted(self, clock: StampClock) -> tuple[float, float]:
        """Age of all samples, their stamps corrected by a clock, and the misfit of a sample in nats."""

    def part_delay_s(self, low_s: float, high_s: float) -> float | None:
        """Age of the samples of a stretch; None where it does not show."""

    def part_mismatch(self, low_s: float, high_s: float, delay_s: float) -> float:
        """Misfit of all samples of a stretch at an age, nats."""


@dataclass(frozen=True, slots=True)
class StampClock:
    """`delay_s` is how much older than its stamp a sample is mid-log, negative where it is acted on later.

    Over the log the delay grows by `drift_s` on the whole, or by `jump_s` at once at `jump_at_s`; both 0 as a rule.
    """

    delay_s: float
    middle_s: float = 0.0
    span_s: float = 1.0
    drift_s: float = 0.0
    jump_s: float = 0.0
    jump_at_s: float = 0.0

    @property
    def even(self) -> bool:
        """Whether the clock neither drifts nor jumps."""
        return not (self.drift_s or self.jump_s)

    def off_s(self, t_s: Array) -> Array:
        """Return by how much more than `delay_s` samples with these time stamps are delayed."""
        drift = self.drift_s * (t_s - self.middle_s) / self.span_s
        return np.asarray(drift + self.jump_s * ((t_s >= self.jump_at_s) - 0.5))

    def corrected(self, samples: Samples) -> Samples:
        """Return samples with time stamps of an even clock, but for those that a jump puts before an earlier one."""
        t_s = samples.t_s - self.off_s(samples.t_s)
        keep = t_s > np.concatenate([[-np.inf], np.maximum.accumulate(t_s)[:-1]])
        return replace(picked(samples, keep), t_s=t_s[keep])

    def notes(self, whose: str) -> tuple[str, ...]:
        """Describe a drift or a jump for the operator; `whose`: "poses'" or "commands'"."""
        if self.drift_s:
            per_s = 1e3 * self.drift_s / self.span_s
            return (
                f"the {whose} clock drifts against the wheels' by {per_s:+.2f} ms every second, "
                f"{1e3 * self.drift_s:+.0f} ms over the log: their stamps are corrected; synchronise the clocks",
            )
        if self.jump_s:
            return (
                f"the {whose} clock jumps against the wheels' by {1e3 * self.jump_s:+.0f} ms at "
                f"{self.jump_at_s:.0f} s: their stamps are corrected; synchronise the clocks",
            )
        return ()


def picked(of: Columns, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> Columns:
    """Return the samples that a mask or places select, of a dataclass with columns (n,)."""
    values = ((each.name, getattr(of, each.name)) for each in fields(of))
    columns: dict[str, Any] = {name: value[chosen] for name, value in values if isinstance(value, np.ndarray)}
    return replace(of, **columns)


def joined(parts: Sequence[Columns]) -> Columns:
    """Return the samples of all parts in a row, of a dataclass with columns only."""
    columns = {each.name: np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(parts[0])}
    return replace(parts[0], **columns)


def between(of: Stamped, begin_s: float, end_s: float) -> Stamped:
    """Return the samples that are stamped in a span of time."""
    return picked(of, (of.t_s >= begin_s) & (of.t_s < end_s))


def clock_of(align: Alignment, settings: GridSettings, least_error_s: float, least_nats: float) -> StampClock:
    """Estimate the delay of samples, and its drift or jump, from one stretch of the log after the other.

    A drift or a jump is accepted if the stretches agree on it far beyond their scatter, if it is no less than
    `least_error_s`, and if the whole log fits better with it by `least_nats` per sample; of both the one that fits
    better. One stretch that is off looks like a jump to the others.
    """
    delay_s, least = align.fitted(StampClock(0.0))
    plain = StampClock(delay_s)
    first, last = align.span_s
    middles, delays = by_stretch(align)
    # A step has two stretches on either side.
    if delays.size < 4 or middles[-1] - middles[0] < settings.least_clock_share * (last - first):
        return plain
    centred = (middles - 0.5 * (first + last)) / (last - first)
    far_s = settings.clock_outlier_s
    most = _level(delays, far_s)[0] / settings.clock_times_better
    of_drift, drift_s = _line(centred, delays, far_s)
    # The step that the stretches show best lies between two of them.
    steps = []
    for k in range(2, delays.size - 1):
        (before, begin_s), (after, end_s) = _level(delays[:k], far_s), _level(delays[k:], far_s)
        steps.append((before + after, k, begin_s, end_s))
    squares, place, *sides = min(steps)
    drifting = StampClock(delay_s, 0.5 * (first + last), last - first, drift_s=drift_s)
    at_s = float(0.5 * (middles[place - 1] + middles[place]))
    jumping = StampClock(delay_s, jump_s=sides[1] - sides[0], jump_at_s=at_s)
    likely = sorted(((of_drift, drifting), (squares, jumping)), key=lambda one: one[0])
    sizes = [max(abs(clock.drift_s), abs(clock.jump_s)) for _, clock in likely]
    if sizes[0] < least_error_s:
        return plain
    best, least = plain, least - least_nats
    for (left, clock), size_s in zip(likely, sizes, strict=True):
        if left > most or size_s < least_error_s:
            break
        at_s = jump_instant(align, (sides[0], sides[1]), clock.jump_at_s) if clock.jump_s else clock.jump_at_s
        tried = replace(clock, jump_at_s=at_s)
        delay_s, mismatch = align.fitted(tried)
        if mismatch < least:
            best, least = replace(tried, delay_s=delay_s), mismatch
    return best


def _level(delays: Array, far_s: float) -> tuple[float, float]:
    """Return a robust sum of squares of delays (n,), and the median of those that agree.

    Delays agree if they are closer than `far_s` to the level that most agree on. The squares are taken about the mean
    of these; a delay further off than `far_s` counts as `far_s`.
    """
    off = delays - delays[:, None]
    level = float(delays[int(np.argmin(np.minimum(off**2, far_s**2).sum(axis=1)))])
    agree = np.abs(delays - level) < far_s
    return _squares(delays - delays[agree].mean(), far_s), float(np.median(delays[agree]))


def _line(x: Array, delays: Array, far_s: float) -> tuple[float, float]:
    """Fit a robust line of delays over `x` (n,); return its sum of squares, cut off at `far_s`, and its slope."""
    first, second = np.triu_indices(x.size, 1)
    slopes = (delays[second] - delays[first]) / (x[second] - x[first])
    off = delays - delays[first, None] - slopes[:, None] * (x - x[first, None])
    agree = np.abs(off[int(np.argmin(np.minimum(off**2, far_s**2).sum(axis=1)))]) < far_s
    slope, level = np.polyfit(x[agree], delays[agree], 1)
    return _squares(delays - level - slope * x, far_s), float(slope)


def _squares(off_s: Array, far_s: float) -> float:
    return float(np.minimum(off_s**2, far_s**2).sum())


def by_stretch(align: Alignment) -> tuple[Array, Array]:
    """Middles of stretches of even length, and the age of the samples of each that shows one.

    Of a long log the stretches are longer: there are `_MOST_STRETCHES` at most.
    """
    first, last = align.span_s
    count = min(max(int((last - first) / align.stretch_s), 1), _MOST_STRETCHES)
    middles, delays = [], []
    for low, high in pairwise(np.linspace(first, last + 1e-6, count + 1).tolist()):
        delay_s = align.part_delay_s(low, high)
        if delay_s is not None:
            middles.append(0.5 * (low + high))
            delays.append(delay_s)
    return np.array(middles), np.array(delays)


def jump_instant(align: Alignment, sides: tuple[float, float], about_s: float) -> float:
    """When samples jumped from one age to another: where both sides together fit best.

    To a second; in a long log, whose stretches are so many times longer, to as many seconds.
    """
    first, last = align.span_s
    times_longer = max((last - first) / (_MOST_STRETCHES * align.stretch_s), 1.0)
    reach_s = times_longer * align.stretch_s
    reach = np.arange(about_s - reach_s, about_s + reach_s, times_longer)
    costs = [
        align.part_mismatch(-np.inf, at_s, sides[0]) + align.part_mismatch(at_s, np.inf, sides[1])
        for at_s in reach.tolist()
    ]
    return float(reach[int(np.argmin(costs))])


# So long before its log begins nothing is stamped; logs that are joined lie further apart.
_EARLY_S = 2.0

ClockOf = Callable[[Wheels, Samples], tuple[StampClock, bool]]
"""The clock of samples against that of the wheels, without a delay where none is seen, and whether it is known."""


@dataclass(frozen=True, slots=True)
class Aligned(Generic[Samples]):
    """Samples whose stamps run evenly, older than these by `delay_s` in every log.

    `known`: whether any log shows how late they are; `even`: whether stamps ran so by themselves; `apart_s`: standard
    deviation by which logs differed, 0 where they are taken as one; `notes`: what a person has to know.
    """

    samples: Samples
    delay_s: float
    known: bool
    even: bool
    apart_s: float
    notes: tuple[str, ...]


def aligned(
    wheels: Wheels, samples: Samples, begins_s: Sequence[float], clock_of: ClockOf[Samples], least_s: float, whose: str
) -> Aligned[Samples]:
    """Align the samples of one log, or of several that begin at `begins_s`, by the clock of each log.

    Delays of logs that lie within `least_s` about their median are taken as one. Of a log that does not show its own
    nobody knows a better one than that of the others; where no log does, they are looked at together. `whose`: "poses'"
    or "commands'".
    """
    edges_s = [-np.inf, *(begin_s - _EARLY_S for begin_s in begins_s[1:]), np.inf]
    logs = [(between(wheels, *span), between(samples, *span)) for span in pairwise(edges_s)]
    seen = [clock_of(*log) for log in logs] if len(logs) > 1 else []
    clocks = [(clock, known and clock.delay_s != 0.0) for clock, known in seen]
    delays = [clock.delay_s for clock, known in clocks if known]
    if not delays:
        clock, known = clock_of(wheels, samples)
        return Aligned(clock.corrected(samples), clock.delay_s, known, clock.even, 0.0, clock.notes(whose))
    middle_s = float(np.median(delays))
    apart = max(abs(delay_s - middle_s) for delay_s in delays) >= least_s
    parts: list[Samples] = []
    uneven: list[str] = []
    notes: list[str] = []
    for number, ((_, one_clock), (clock, known)) in enumerate(zip(logs, clocks, strict=True), 1):
        even = clock.corrected(one_clock)
        parts.append(replace(even, t_s=even.t_s - (clock.delay_s - middle_s)) if apart and known else even)
        if not clock.even:
            how = f"{1e3 * clock.drift_s:+.0f} ms over" if clock.drift_s else f"{1e3 * clock.jump_s:+.0f} ms at once in"
            uneven.append(f"{how} log {number}")
    if uneven:
        notes.append(
            f"the {whose} clock runs unevenly against the wheels' ({', '.join(uneven)}): their stamps are corrected; "
            "synchronise the clocks"
        )
    if apart:
        listed = ", ".join(f"{clock.delay_s:.3g} s" if known else "not known" for clock, known in clocks)
        notes.append(
            f"the {whose} delay against the wheels differs from log to log ({listed}): each log is laid by its own, as"
            f" if it were {middle_s:.3g} s in all; synchronise the clocks"
        )
    return Aligned(
        joined(parts), middle_s, True, not uneven, float(np.std(delays, ddof=1)) if apart else 0.0, tuple(notes)
    )
