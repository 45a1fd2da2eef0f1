import pytest
from hypothesis import strategies as st

from disco_hw.daemon.loop import Loop, MonotonicClock
from tests.daemon.simulated_clock import SimulatedClock
from tests.tables import examples

PERIOD_NS = 20_000_000
MS_NS = 1_000_000


class Run:
    """A loop at 50 Hz on a simulated clock whose ticks last as long as given, then nothing."""

    def __init__(self, durations_ns, wake_delays_ns=()):
        self.clock = DelayedClock(wake_delays_ns)
        self.loop = Loop(self.clock, 50.0)
        self.durations_ns = list(durations_ns)
        self.starts_ns = []
        self.loop.run(self.tick, lambda: not self.durations_ns)
        self.stats = self.loop.stats

    def tick(self, now_ns):
        assert now_ns == self.clock.now_ns()
        self.starts_ns.append(now_ns)
        self.clock.advance_ns(self.durations_ns.pop(0))


class DelayedClock(SimulatedClock):
    """Wakes up late by the given times, then on time."""

    def __init__(self, wake_delays_ns):
        super().__init__()
        self.wake_delays_ns = list(wake_delays_ns)

    def sleep_until_ns(self, deadline_ns):
        super().sleep_until_ns(deadline_ns)
        if self.wake_delays_ns:
            self.advance_ns(self.wake_delays_ns.pop(0))


def test_ticks_lie_on_the_grid_whatever_they_take():
    run = Run([3 * MS_NS, 0, 19 * MS_NS, 20 * MS_NS, 1] * 20)
    assert run.starts_ns == [k * PERIOD_NS for k in range(100)]
    assert run.stats.ticks == 100
    assert (run.stats.overruns, run.stats.skipped_periods) == (0, 0)
    assert run.stats.lateness.summary_s()["max_s"] == 0.0
    assert run.stats.duration.summary_s()["max_s"] == 0.02


def test_late_wake_ups_do_not_accumulate():
    run = Run([MS_NS] * 100, [5 * MS_NS] * 100)
    assert run.starts_ns == [k * PERIOD_NS + 5 * MS_NS for k in range(100)]
    assert run.stats.lateness.summary_s()["mean_s"] == pytest.approx(0.005)
    assert run.stats.last_lateness_ns == 5 * MS_NS


@pytest.mark.parametrize(
    ("first_ms", "wake_delays_ms", "starts_ms", "skipped_periods"),
    [
        (25, [], [0, 25, 40], 0),
        # 20 to 80 ms are missed by more than half a period; 100 ms is next.
        (95, [], [0, 100, 120], 4),
        (1, [0, 10_000], [0, 10_020, 10_040], 500),
    ],
    ids=["short overrun", "long overrun", "stopped process"],
)
def test_an_overrun_is_counted_and_skips_whole_periods_without_a_burst(
    first_ms, wake_delays_ms, starts_ms, skipped_periods
):
    run = Run([first_ms * MS_NS, MS_NS, MS_NS], [delay_ms * MS_NS for delay_ms in wake_delays_ms])
    assert run.starts_ns == [start_ms * MS_NS for start_ms in starts_ms]
    assert (run.stats.overruns, run.stats.skipped_periods) == (1, skipped_periods)


@examples(
    quick=30,
    every=100,
    durations_ns=st.lists(st.integers(0, 5 * PERIOD_NS) | st.integers(0, PERIOD_NS // 10), min_size=1, max_size=60),
    wake_delays_ns=st.lists(st.integers(0, 3 * PERIOD_NS) | st.just(0), max_size=60),
)
def test_whatever_is_late_there_is_no_burst_and_every_period_is_accounted_for(durations_ns, wake_delays_ns):
    run = Run(durations_ns, wake_delays_ns)
    gaps_ns = [after - before for before, after in zip(run.starts_ns, run.starts_ns[1:], strict=False)]
    assert all(gap_ns >= PERIOD_NS // 2 for gap_ns in gaps_ns)
    # The last tick that started served the deadline number ticks - 1 + skipped, less what was skipped after it.
    served_deadline_ns = run.starts_ns[-1] - run.stats.last_lateness_ns
    assert served_deadline_ns % PERIOD_NS == 0
    last_skips = run.stats.skipped_periods - (served_deadline_ns // PERIOD_NS - (run.stats.ticks - 1))
    assert last_skips >= 0
    assert run.stats.ticks == len(durations_ns)


def test_stopping_is_asked_after_the_sleep_so_no_tick_follows_the_request():
    clock = SimulatedClock()
    starts_ns = []
    Loop(clock, 50.0).run(starts_ns.append, lambda: clock.now_ns() >= 2 * PERIOD_NS)
    assert starts_ns == [0, PERIOD_NS]


def test_an_exception_ends_the_loop_and_reaches_the_caller():
    loop = Loop(SimulatedClock(), 50.0)

    def tick(now_ns):
        if now_ns == 3 * PERIOD_NS:
            raise RuntimeError("broken plan")

    with pytest.raises(RuntimeError, match="broken plan"):
        loop.run(tick, lambda: False)
    assert loop.stats.ticks == 3


def test_stages_last_from_mark_to_mark_within_a_tick_and_show_the_last_complete_one():
    clock = SimulatedClock()
    loop = Loop(clock, 50.0)
    seen = []

    def tick(now_ns):
        clock.advance_ns(1 * MS_NS)
        loop.stages.mark("receive")
        seen.append(loop.stages.last_ns)
        clock.advance_ns(7 * MS_NS)
        loop.stages.mark("plan")
        clock.advance_ns(2 * MS_NS)
        loop.stages.mark("receive")
        if now_ns == 0:
            clock.advance_ns(4 * MS_NS)
            loop.stages.mark("status")

    loop.run(tick, lambda: len(seen) == 3)
    assert seen == [
        {},
        {"receive": 3 * MS_NS, "plan": 7 * MS_NS, "status": 4 * MS_NS},
        {"receive": 3 * MS_NS, "plan": 7 * MS_NS},
    ]


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_absurd_rates_are_refused(rate_hz):
    with pytest.raises(ValueError, match="rate_hz"):
        Loop(SimulatedClock(), rate_hz)


def test_on_the_wall_clock_the_deadlines_stay_on_the_grid():
    loop = Loop(MonotonicClock(), 100.0)
    deadlines_ns, skipped = [], []

    def tick(now_ns):
        deadlines_ns.append(now_ns - loop.stats.last_lateness_ns)
        skipped.append(loop.stats.skipped_periods)

    loop.run(tick, lambda: len(deadlines_ns) == 30)
    assert deadlines_ns == [deadlines_ns[0] + (k + skipped[k]) * 10_000_000 for k in range(30)]
