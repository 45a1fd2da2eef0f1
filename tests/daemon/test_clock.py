import time

import pytest

from disco_hw.daemon.loop import MonotonicClock, SuspendWatch


def test_monotonic_clock_never_returns_before_the_deadline():
    clock = MonotonicClock()
    for offset_ns in (5_000_000, 200_000, 1, 0, -10_000_000):
        deadline_ns = clock.now_ns() + offset_ns
        clock.sleep_until_ns(deadline_ns)
        assert clock.now_ns() >= deadline_ns


def test_monotonic_clock_is_the_hosts_monotonic_clock():
    before_ns = time.monotonic_ns()
    now_ns = MonotonicClock().now_ns()
    assert before_ns <= now_ns <= time.monotonic_ns()


def test_monotonic_clock_gives_the_cpu_away_while_it_waits():
    clock = MonotonicClock()
    cpu_before_s = time.thread_time()
    clock.sleep_until_ns(clock.now_ns() + 100_000_000)
    assert time.thread_time() - cpu_before_s < 0.05


def test_a_suspend_is_noticed_once_and_a_thread_that_is_held_up_between_two_clocks_is_none():
    now_ns = {time.CLOCK_MONOTONIC: 10**9, time.CLOCK_BOOTTIME: 5 * 10**9}
    held_up_ns = [0]

    def read_ns(clock):
        found_ns = now_ns[clock]
        for each in now_ns:
            now_ns[each] += held_up_ns[0]
        return found_ns

    watch = SuspendWatch(read_ns)
    for held_up_ns[0] in (0, 10**9, 0):
        assert watch.suspended_s() == 0.0
    now_ns[time.CLOCK_BOOTTIME] += 60_000_000
    assert watch.suspended_s() == pytest.approx(0.06)
    assert watch.suspended_s() == 0.0


def test_a_computer_that_is_not_suspended_is_not_taken_for_one():
    watch = SuspendWatch()
    time.sleep(0.06)
    assert watch.suspended_s() == 0.0
