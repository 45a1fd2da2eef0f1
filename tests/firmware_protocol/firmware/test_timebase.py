"""The core's two clocks: the caller's and the count of its own cycles. Where they come apart, the robot stops."""

import dataclasses
import itertools
import math
import random

import pytest

from tests.firmware_protocol.bench import CONFIG, FAULTS, MS, Bench
from tests.tables import thinned

SPEED = 4.0
RAMP_CYCLES = math.ceil(SPEED / CONFIG.stop_deceleration_rad_s2 * 1000)
TIMEOUT_MS = 100
TOLERANCE_MS = 20
RATES = [0.0, 1e-6, 0.001, 0.01, 0.1, 0.3, 0.5, 0.7, 0.8, 0.85, 0.88]
RATES += [1.12, 1.15, 1.2, 1.5, 2.0, 3.0, 10.0, 100.0, 1000.0]


class OtherClock:
    """A core whose board tells it another time than passes: `clock` gives what it shows at a true time (us)."""

    def __init__(self, core):
        self.core = core
        self.clock = lambda true_us: true_us

    def receive(self, true_us, can_id, data):
        self.core.receive(self.clock(true_us), can_id, data)

    def step(self, true_us, inputs):
        return self.core.step(self.clock(true_us), inputs)

    def __getattr__(self, name):
        return getattr(self.core, name)


def with_clock(bench):
    bench.core = OtherClock(bench.core)
    return bench


def driving(config=CONFIG, start_us=0):
    return with_clock(Bench.driving(SPEED, SPEED / 2, config, start_us))


def run_at(bench, rate):
    """From now on the clock runs at this rate."""
    since_us = bench.now_us
    bench.core.clock = lambda true_us: since_us + math.floor((true_us - since_us) * rate)


def leap(bench, leap_us):
    """With the next cycle the clock leaps, to zero at the least."""
    begin_us = bench.now_us
    bench.core.clock = lambda true_us: max(0, true_us + leap_us * (true_us > begin_us))


def cycles_until(bench, holds, at_most):
    for cycles in range(1, at_most + 1):
        bench.step()
        if holds(bench.out):
            return cycles
    raise AssertionError(f"not within {at_most} cycles: {bench.out}")


def is_stopped(out):
    return out.state != "ARMED"


def has_zero_setpoints(out):
    return out.left_setpoint_rad_s == 0.0 and out.right_setpoint_rad_s == 0.0


def stops_within(bench, cycles):
    """The robot is no longer armed within so many cycles, and its setpoints are zero at the end of the ramp."""
    cycles_until(bench, is_stopped, cycles)
    cycles_until(bench, has_zero_setpoints, RAMP_CYCLES + 1)


def stays_stopped(bench, cycles=900):
    """Whatever the host goes on asking for."""
    for k in range(cycles):
        assert bench.step().state != "ARMED"
        assert has_zero_setpoints(bench.out)
        if k % 200 == 0:
            bench.set_request("READY" if k % 400 else "ARM", session=8 + k // 200)


@thinned("rate", RATES, quick=5)
def test_a_clock_that_begins_to_run_at_another_rate_stops_a_robot_whose_host_goes_on(rate):
    bench = driving()
    run_at(bench, rate)
    apart_a_cycle = abs(rate - 1.0) - 0.1
    stops_within(bench, math.ceil(TOLERANCE_MS / apart_a_cycle) + 1)
    stays_stopped(bench)


@thinned("rate", [*RATES, 0.9, 0.95, 0.99, 1.0, 1.01, 1.05, 1.1], quick=7)
@thinned("delay_us", [0, 1, 300, 999], quick=2)
def test_with_a_silent_host_the_wheels_stand_in_the_watchdogs_time_by_either_clock(rate, delay_us):
    bench = driving()
    bench.command = None
    bench.now_us += delay_us
    bench.wheel_command(SPEED, SPEED / 2)
    bench.now_us -= delay_us
    run_at(bench, rate)
    by_clock = math.ceil((TIMEOUT_MS + delay_us * 1e-3) / rate) if rate else math.inf
    stops_within(bench, min(TIMEOUT_MS, by_clock) + 1)
    stays_stopped(bench)


@thinned("rate", RATES, quick=5)
def test_a_robot_whose_clock_never_ran_right_is_never_armed(rate):
    bench = with_clock(Bench())
    run_at(bench, rate)
    bench.hello()
    bench.command = {}
    stays_stopped(bench, 2000)
    assert "FAULT" in bench.blockers()


@pytest.mark.parametrize("sign", [1, -1])
@thinned("leap_us", [21_100, 25_000, 60_000, 250_000, 10**6, 3600 * 10**6, 10**15], quick=3)
def test_one_leap_of_the_clock_stops_the_robot_at_once(leap_us, sign):
    bench = driving(start_us=40_000 * MS)
    leap(bench, sign * leap_us)
    assert bench.step().state == "STOPPING"
    assert (bench.out.stop_cause, bench.fault()) == ("FAULT", "CLOCK_MISMATCH")
    cycles_until(bench, has_zero_setpoints, RAMP_CYCLES + 1)
    stays_stopped(bench)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("leap_us", "stops"), [(20_100, False), (20_101, True)])
def test_the_tolerance_is_twenty_milliseconds_and_what_a_cycle_forgets(sign, leap_us, stops):
    bench = driving()
    bench.run(30)
    leap(bench, sign * leap_us)
    assert (bench.step().fault == FAULTS["CLOCK_MISMATCH"]) == stops


@pytest.mark.parametrize("sign", [1, -1])
def test_however_far_it_leapt_the_fault_passes_in_its_time(sign):
    """Counted as 40 ms, less the cycle itself; a tenth of a cycle is forgotten in each; then the hold of 0.5 s."""
    bench = with_clock(Bench(start_us=100_000 * MS))
    bench.run(100)
    leap(bench, sign * 90_000_000)
    cycles = cycles_until(bench, lambda out: out.fault, 1) + cycles_until(bench, lambda out: not out.fault, 1000)
    # From 38.9 ms, or 40 ms where it went back, to the tolerance of 20 ms, by 0.1 ms a cycle.
    assert cycles == (189 if sign > 0 else 200) + 500


@pytest.mark.parametrize(("rate", "samples"), [(0.0, 100), (0.001, 100), (0.5, 100), (2.0, 200), (3.0, 300)])
def test_once_apart_the_cores_own_time_goes_by_the_faster_of_the_two_clocks(rate, samples):
    """One sample of the wheels in ten milliseconds of it."""
    bench = with_clock(Bench())
    run_at(bench, rate)
    assert bench.run(200).fault == FAULTS["CLOCK_MISMATCH"]
    begin_us = bench.now_us
    bench.run(1000)
    assert len(bench.messages("WHEEL_SPEED", begin_us + 1)) == pytest.approx(samples, abs=1)


def device_time_us(bench):
    bench.send("TIME_REQUEST", sequence=1)
    bench.step()
    return bench.messages("TIME_RESPONSE")[-1].values["receive_time"]


def test_the_cores_own_time_is_that_of_a_clock_whose_cycles_jitter():
    bench, generator = Bench(), random.Random(1)
    for _ in range(1000):
        bench.step(generator.randrange(500, 1500))
    now_us = bench.now_us
    assert device_time_us(bench) == now_us


def test_after_a_leap_frames_within_the_cycles_make_time_no_faster(bench):
    assert bench.step(100 * MS).fault == FAULTS["CLOCK_MISMATCH"]
    for _ in range(100):
        bench.now_us += 400
        bench.send("TIME_REQUEST", sequence=2)
        bench.now_us -= 400
        bench.step()
    now_us = bench.now_us
    assert device_time_us(bench) == now_us


def test_the_fault_passes_once_the_clock_is_sound_again():
    bench = driving()
    leap(bench, 10**6)
    bench.request = bench.command = None
    assert bench.run(500).fault == FAULTS["CLOCK_MISMATCH"]
    assert bench.run(300).fault == 0
    bench.to_armed(session=9)


@pytest.mark.parametrize("leap_us", [1000, 10_000, 18_000, -1000, -10_000, -18_000])
def test_with_a_silent_host_no_row_of_small_leaps_keeps_the_robot_armed(leap_us):
    """To and fro, each within the tolerance: the clock loses as much as it gains."""
    bench = driving()
    bench.command = None
    bench.wheel_command(SPEED, SPEED / 2)
    begin_us = bench.now_us
    bench.core.clock = lambda true_us: true_us + leap_us * ((true_us - begin_us) // MS % 2)
    stops_within(bench, TIMEOUT_MS + 1)


@pytest.mark.parametrize("config", [CONFIG, dataclasses.replace(CONFIG, cycle_s=0.005)], ids=["1 kHz", "200 Hz"])
@thinned("rate", [0.91, 0.999, 0.9999, 1.0, 1.00004, 1.001, 1.09], quick=2)
@thinned("jitter", [0.99, 0.5, 0.0], quick=1)
def test_no_sound_clock_stops_the_robot_whose_cycles_jitter(config, rate, jitter):
    """Cycles a tenth too long or too short, each up to a whole period late or early, and now and then one lost."""
    bench = driving(config)
    cycle_us, generator = config.cycle_s * 1e6, random.Random(3)
    begin_us = bench.now_us
    for k in itertools.count(1):
        gap_us = 0.5 * cycle_us * (k % 50 == 0)
        due_us = begin_us + k * cycle_us * rate + generator.uniform(-jitter, jitter) * 0.5 * cycle_us + gap_us
        step_to(bench, math.floor(due_us))
        assert bench.out.state == "ARMED", (k, bench.out)
        if bench.now_us - begin_us > 5_000_000:
            break


def step_to(bench, due_us):
    """The next cycle at this time; the host's frames are due by the clock, at whatever cycle comes first."""
    for period_us, send in ((50 * MS, lambda: host_state(bench)), (20 * MS, lambda: bench.wheel_command(SPEED, 2.0))):
        if due_us // period_us != bench.now_us // period_us:
            send()
    request, command = bench.request, bench.command
    bench.request = bench.command = None
    bench.now_us, elapsed_us = due_us - 1, due_us - bench.now_us
    bench.ticks = [
        t + s * bench.config.ticks_per_rev / (2e6 * math.pi) * elapsed_us
        for t, s in zip(bench.ticks, bench.speeds, strict=True)
    ]
    bench.step(1)
    bench.request, bench.command = request, command


def host_state(bench):
    bench.host_state(request="ARM", session=bench.request["session"])


@pytest.mark.parametrize("pause_ms", [2, 5, 10, 20])
def test_a_pause_within_the_tolerance_stops_nothing_even_once_in_a_quarter_of_a_second(pause_ms):
    bench = driving()
    for _ in range(8):
        step_to(bench, bench.now_us + pause_ms * MS)
        for _ in range(250):
            step_to(bench, bench.now_us + MS)
            assert bench.out.state == "ARMED"


def test_cycles_of_a_period_that_is_not_the_configured_one_are_refused():
    bench = Bench(dataclasses.replace(CONFIG, cycle_s=0.002))
    for _ in range(100):
        bench.step(MS)
    assert bench.out.fault == FAULTS["CLOCK_MISMATCH"]
