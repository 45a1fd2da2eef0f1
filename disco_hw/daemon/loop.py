"""The control loop: absolute deadlines, skipped periods counted and never caught up, every stage timed."""

from __future__ import annotations

from collections.abc import Callable

from disco_hw.daemon.clock import Clock
from disco_hw.daemon.histogram import Histogram


class StageTimer:
    """How long the named parts of a tick take: each lasts from the mark before it, or the tick's start, to its own.

    A name that is marked more than once in a tick adds up.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._since_ns = clock.now_ns()
        self._present_ns: dict[str, int] = {}
        self._last_ns: dict[str, int] = {}
        self._histograms: dict[str, Histogram] = {}

    def begin(self, now_ns: int) -> None:
        """Start a tick: its first stage begins now."""
        self._since_ns = now_ns
        self._present_ns.clear()

    def mark(self, name: str) -> None:
        """End the stage of that name here."""
        now_ns = self._clock.now_ns()
        self._present_ns[name] = self._present_ns.get(name, 0) + now_ns - self._since_ns
        self._since_ns = now_ns

    def complete(self) -> None:
        """End the tick: what was marked becomes `last_ns` and is counted."""
        for name, duration_ns in self._present_ns.items():
            if name not in self._histograms:
                self._histograms[name] = Histogram()
            self._histograms[name].record(duration_ns)
        self._last_ns, self._present_ns = self._present_ns, self._last_ns

    def last_ns(self) -> dict[str, int]:
        """Return how long each stage of the last complete tick took."""
        return dict(self._last_ns)

    def summary_s(self) -> dict[str, dict[str, float]]:
        """Return each stage's summary, see `Histogram.summary_s`."""
        return {name: histogram.summary_s() for name, histogram in self._histograms.items()}


class LoopStats:
    """Figures of the loop since it was made.

    `lateness`: start of a tick after its deadline. `duration`: of the tick itself. `period`: between starts of two
    ticks. `overruns`: ticks that ended after the next deadline. `skipped_periods`: deadlines without a tick.
    """

    def __init__(self) -> None:
        self.ticks = 0
        self.overruns = 0
        self.skipped_periods = 0
        self.last_lateness_ns = 0
        self.last_duration_ns = 0
        self.lateness = Histogram()
        self.duration = Histogram()
        self.period = Histogram()

    def summary(self) -> dict[str, float | dict[str, float]]:
        """Return all figures, durations in seconds."""
        return {
            "ticks": self.ticks,
            "overruns": self.overruns,
            "skipped_periods": self.skipped_periods,
            "lateness": self.lateness.summary_s(),
            "duration": self.duration.summary_s(),
            "period": self.period.summary_s(),
        }


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
        previous_start_ns: int | None = None
        while True:
            clock.sleep_until_ns(deadline_ns)
            # Asked after the sleep, so that a request to stop that came meanwhile gets no further tick.
            if should_stop():
                return
            start_ns = clock.now_ns()
            stats.last_lateness_ns = start_ns - deadline_ns
            stats.lateness.record(stats.last_lateness_ns)
            if previous_start_ns is not None:
                stats.period.record(start_ns - previous_start_ns)
            previous_start_ns = start_ns
            self.stages.begin(start_ns)
            tick(start_ns)
            self.stages.complete()
            end_ns = clock.now_ns()
            stats.ticks += 1
            stats.last_duration_ns = end_ns - start_ns
            stats.duration.record(stats.last_duration_ns)
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
