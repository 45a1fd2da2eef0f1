"""Control loop with absolute deadlines: skipped periods are counted and never caught up, every stage is timed."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """Time in integer nanoseconds that never steps back."""

    def now_ns(self) -> int:
        """Return the present time in nanoseconds."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at the absolute time `deadline_ns` or later; at once if it has passed."""


class MonotonicClock:
    """CLOCK_MONOTONIC of this host."""

    def now_ns(self) -> int:
        """Return the present time in nanoseconds."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at the absolute time `deadline_ns` or later; at once if it has passed."""
        # The remaining time is taken anew each round, so a short or interrupted sleep cannot accumulate drift.
        while (remaining_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(remaining_ns * 1e-9)


# Chosen: shorter than any controller's watchdog.
_SUSPENDED_NS = 50_000_000


class SuspendWatch:
    """Notices that the computer was suspended: CLOCK_MONOTONIC stands still then, and CLOCK_BOOTTIME goes on."""

    def __init__(self, read_ns: Callable[[int], int] = time.clock_gettime_ns) -> None:
        self._read_ns = read_ns
        monotonic_ns = read_ns(time.CLOCK_MONOTONIC)
        self._apart_ns = read_ns(time.CLOCK_BOOTTIME) - monotonic_ns

    def suspended_s(self) -> float:
        """Return for how long the computer was suspended since the last call (s), 0 if it was not.

        A thread that was held up is never taken for that.
        """
        boot_ns = self._read_ns(time.CLOCK_BOOTTIME)
        apart_ns = boot_ns - self._read_ns(time.CLOCK_MONOTONIC)
        suspended_ns = apart_ns - self._apart_ns
        self._apart_ns = max(apart_ns, self._apart_ns)
        return suspended_ns * 1e-9 if suspended_ns > _SUSPENDED_NS else 0.0


# Leading binary digits that a bucket keeps, so that it is at most 1/64 wide.
_KEPT_BITS = 7


class Histogram:
    """Counts of durations in nanoseconds, in buckets at most 1/64 wide (1.6 %).

    The buckets are those of a high-dynamic-range histogram: exact up to 127, then 64 to each power of two.
    """

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._count = 0
        self._total_ns = 0
        self._max_ns = 0

    def record(self, duration_ns: int) -> None:
        """Count one duration in its bucket; a negative one counts as 0."""
        duration_ns = max(duration_ns, 0)
        self._counts[_upper_edge_ns(duration_ns)] += 1
        self._count += 1
        self._total_ns += duration_ns
        self._max_ns = max(self._max_ns, duration_ns)

    def percentile_ns(self, percent: float) -> float:
        """Return the duration that `percent` of all do not exceed, at most 1.6 % too high; NaN before the first."""
        # Rounded first: 99.9 % of 41000 is 40959, not the next integer above 40959.00000000001.
        rank = max(1, math.ceil(round(percent * self._count / 100.0, 6)))
        seen = 0
        for upper_edge_ns, count in sorted(self._counts.items()):
            seen += count
            if seen >= rank:
                return float(min(upper_edge_ns, self._max_ns))
        return math.nan

    def summary_s(self) -> dict[str, float]:
        """Return p50, p99, p99.9, max and mean in seconds under the keys p50_s, p99_s, p999_s, max_s, mean_s."""
        return {
            "p50_s": self.percentile_ns(50.0) * 1e-9,
            "p99_s": self.percentile_ns(99.0) * 1e-9,
            "p999_s": self.percentile_ns(99.9) * 1e-9,
            "max_s": self._max_ns * 1e-9,
            "mean_s": self._total_ns * 1e-9 / self._count if self._count else math.nan,
        }


def _upper_edge_ns(duration_ns: int) -> int:
    """Return the longest duration that is counted in the same bucket."""
    shift = max(0, duration_ns.bit_length() - _KEPT_BITS)
    return (((duration_ns >> shift) + 1) << shift) - 1


class StageTimer:
    """Timer of the named parts of a tick: each lasts from the mark before it, or the tick's start, to its own.

    A name that is marked more than once in a tick adds up. `last_ns`: how long each lasted in the last complete tick.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since_ns = clock.now_ns()
        self._present_ns: dict[str, int] = {}
        self.last_ns: dict[str, int] = {}

    def begin(self, now_ns: int) -> None:
        """Start timing a tick, whose first stage begins now."""
        self._since_ns = now_ns
        self._present_ns = {}

    def mark(self, name: str) -> None:
        """End the stage of that name here."""
        now_ns = self._clock.now_ns()
        self._present_ns[name] = self._present_ns.get(name, 0) + now_ns - self._since_ns
        self._since_ns = now_ns

    def complete(self) -> None:
        """Finish timing a tick: what was marked becomes `last_ns`."""
        self.last_ns = self._present_ns


class LoopStats:
    """Figures of the loop since it was made.

    `lateness`: start of a tick after its deadline. `duration`: of the tick itself. `overruns`: ticks that ended after
    the next deadline. `skipped_periods`: deadlines without a tick.
    """

    def __init__(self) -> None:
        self.ticks = 0
        self.overruns = 0
        self.skipped_periods = 0
        self.last_lateness_ns = 0
        self.lateness = Histogram()
        self.duration = Histogram()


class Loop:
    """Calls a tick at a fixed rate on any clock.

    Deadlines lie on the grid t0 + k T. A deadline missed by less than half a period is served late; any other is
    skipped and counted, so two ticks never start within half a period of each other, however late one was.
    """

    def __init__(self, clock: Clock, rate_hz: float) -> None:
        if not 0.0 < rate_hz <= 10_000.0:
            raise ValueError(f"rate_hz must be within 0 and 10000, not {rate_hz}")
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self.stages = StageTimer(clock)
        self.stats = LoopStats()

    def run(self, tick: Callable[[int], None], should_stop: Callable[[], bool]) -> None:
        """Call `tick(now_ns)` once a period until `should_stop()`, which is asked before each tick.

        What `tick` raises ends the loop and reaches the caller, who stops the robot.
        """
        clock, stats, period_ns = self._clock, self.stats, self._period_ns
        deadline_ns = clock.now_ns()
        while True:
            clock.sleep_until_ns(deadline_ns)
            # Asked after the sleep, so that a request to stop that came meanwhile gets no further tick.
            if should_stop():
                return
            start_ns = clock.now_ns()
            stats.last_lateness_ns = start_ns - deadline_ns
            stats.lateness.record(stats.last_lateness_ns)
            self.stages.begin(start_ns)
            tick(start_ns)
            self.stages.complete()
            end_ns = clock.now_ns()
            stats.ticks += 1
            stats.duration.record(end_ns - start_ns)
            stats.overruns += end_ns > deadline_ns + period_ns
            periods = _periods_to_next(deadline_ns, start_ns, end_ns, period_ns)
            stats.skipped_periods += periods - 1
            deadline_ns += periods * period_ns


def _periods_to_next(deadline_ns: int, start_ns: int, end_ns: int, period_ns: int) -> int:
    """Return how many periods after `deadline_ns` the next tick is due; 1 if all went well.

    The first point of the grid at least half a period after this tick's start and missed by at most half a period.
    """
    earliest_ns = max(start_ns + period_ns // 2, end_ns - period_ns // 2)
    return max(1, -((deadline_ns - earliest_ns) // period_ns))
