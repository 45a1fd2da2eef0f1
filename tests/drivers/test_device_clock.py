import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.device_clock import (
    DEVICE_CLOCK_MODULUS_US,
    HOLDOVER_NS,
    MAX_SKEW,
    SLEW_RATE,
    SYNCED_AFTER,
    DeviceClock,
    age_us,
)

SECOND = 1_000_000_000
START_NS = 7 * 3600 * SECOND


class Device:
    """A device whose clock runs at its own rate, behind a link with delays."""

    def __init__(self, skew=0.0, started_ns=START_NS - 123_456_789, seed=0):
        self.rate = 1.0 / (1.0 + skew)
        self.started_ns = started_ns
        self.random = random.Random(seed)

    def us(self, host_ns):
        return int((host_ns - self.started_ns) * self.rate / 1000) % DEVICE_CLOCK_MODULUS_US

    def exchange(self, clock, now_ns, jitter_ns=0.0, base_ns=400_000):
        there = base_ns + self.random.expovariate(1.0) * jitter_ns
        back = base_ns + self.random.expovariate(1.0) * jitter_ns
        return clock.add(now_ns, round(now_ns + there + back), self.us(now_ns + there))

    def true_offset_ns(self, host_ns):
        return host_ns - (host_ns - self.started_ns) * self.rate


def run(clock, device, seconds, jitter_ns=0.0, start_ns=START_NS):
    """Five exchanges a second for two seconds, then one a second, as the driver asks; returns the last time."""
    now_ns = start_ns
    while now_ns < start_ns + seconds * SECOND:
        device.exchange(clock, now_ns, jitter_ns)
        now_ns += SECOND // 5 if clock.count < 10 else SECOND
    return now_ns


def test_knows_nothing_before_the_first_exchange_nor_from_a_response_before_its_request():
    clock = DeviceClock()
    assert clock.add(2_000, 1_000, 5) is False
    assert clock.count == 0
    assert clock.offset_ns(START_NS) is None
    assert clock.device_us(START_NS) is None
    assert not clock.synced(START_NS)


def test_synced_after_some_exchanges_and_no_longer_after_long_silence():
    clock, device = DeviceClock(), Device()
    for count in range(SYNCED_AFTER):
        assert not clock.synced(START_NS + count)
        device.exchange(clock, START_NS + count * SECOND)
    last_ns = START_NS + SYNCED_AFTER * SECOND
    assert clock.synced(last_ns)
    assert not clock.synced(last_ns + HOLDOVER_NS)


@pytest.mark.parametrize("open_after_s", [0.05, 0.3, 0.7, 0.79, 0.91, 0.97, 1.0, 2.5])
def test_requests_that_waited_together_at_a_link_that_opens_late_make_it_no_wiser(open_after_s):
    """As at an adapter that hands on nothing for a while after it was opened, and then all at once."""
    clock, device = DeviceClock(), Device()
    now_ns, opens_ns = START_NS, START_NS + round(open_after_s * SECOND)
    synced_ns = None
    for _ in range(30):
        received_ns = max(now_ns + 400_000, opens_ns)
        assert not clock.add(now_ns, received_ns + 400_000, device.us(received_ns)), "taken for a restart of the device"
        now_ns += SECOND // 5
        if clock.synced(now_ns):
            assert clock.offset_ns(now_ns) == pytest.approx(device.true_offset_ns(now_ns), abs=1_000_000)
            synced_ns = synced_ns or now_ns
    assert synced_ns is not None
    assert synced_ns <= opens_ns + SECOND


@pytest.mark.parametrize("skew", [-150e-6, 0.0, 20e-6, 150e-6])
@pytest.mark.parametrize("jitter_ns", [0.0, 300_000.0, 3_000_000.0])
def test_offset_and_skew_under_jitter(skew, jitter_ns):
    """Symmetric delays: the error stays well below the jitter after a minute."""
    clock, device = DeviceClock(), Device(skew, seed=3)
    now_ns = run(clock, device, 60, jitter_ns)
    errors = []
    for _ in range(120):
        device.exchange(clock, now_ns, jitter_ns)
        now_ns += SECOND
        errors.append(abs(clock.offset_ns(now_ns) - device.true_offset_ns(now_ns)))
    assert max(errors) < 50_000 + 0.5 * jitter_ns
    assert sum(errors) / len(errors) < 20_000 + 0.2 * jitter_ns
    assert abs(clock.skew - skew) < 3e-6 + jitter_ns * 1e-11


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), skew=st.floats(-1e-3, 1e-3), jitter_ns=st.floats(0, 2e7))
def test_once_in_use_time_never_jumps(seed, skew, jitter_ns):
    """Whatever the delays, stamps move by no more than skew and slew allow, and skew is bounded."""
    clock, device = DeviceClock(), Device(skew, seed=seed)
    now_ns = run(clock, device, 2, jitter_ns)
    for _ in range(50):
        before = clock.offset_ns(now_ns) if clock.synced(now_ns) else None
        count = clock.count
        device.exchange(clock, now_ns - 60_000_000, jitter_ns)
        later_ns = now_ns + SECOND // 10
        if before is not None and clock.count == count + 1:
            allowed = (SLEW_RATE + 2 * MAX_SKEW) * SECOND
            assert abs(clock.offset_ns(later_ns) - before) <= allowed
        assert abs(clock.skew) <= MAX_SKEW
        now_ns = later_ns


def test_delay_on_one_way_only_pulls_the_offset_little():
    """The response waits 3 ms on average, the request never: with every exchange the error is 0.5 ms, so 0.16."""
    errors = []
    for seed in range(10):
        clock, device = DeviceClock(), Device(20e-6, seed=seed)
        for count in range(120):
            now_ns = START_NS + count * SECOND
            back = device.random.expovariate(1.0) * 3_000_000
            clock.add(now_ns, round(now_ns + 800_000 + back), device.us(now_ns + 400_000))
            if count > 20:
                errors.append(abs(clock.offset_ns(now_ns) - device.true_offset_ns(now_ns)))
    assert sum(errors) / len(errors) < 300_000


def test_a_restarted_device_is_noticed_and_followed():
    clock = DeviceClock()
    now_ns = run(clock, Device(), 20)
    restarted = Device(started_ns=now_ns - 50_000)
    assert restarted.exchange(clock, now_ns) is True
    assert not clock.synced(now_ns)
    assert restarted.exchange(clock, now_ns + SECOND) is False
    assert abs(clock.offset_ns(now_ns) - restarted.true_offset_ns(now_ns)) < 10_000


def test_one_slow_exchange_is_no_restart_and_moves_nothing():
    clock, device = DeviceClock(), Device()
    now_ns = run(clock, device, 20)
    before = clock.offset_ns(now_ns)
    assert clock.add(now_ns, now_ns + 400_000_000, device.us(now_ns + 399_000_000)) is False
    assert abs(clock.offset_ns(now_ns + 400_000_000) - before) < 10_000


def test_the_wrap_of_the_device_clock_is_no_restart():
    wrap_ns = DEVICE_CLOCK_MODULUS_US * 1000
    clock, device = DeviceClock(), Device(started_ns=START_NS - wrap_ns + 10 * SECOND)
    now_ns = START_NS
    for _ in range(30):
        assert device.exchange(clock, now_ns) is False
        now_ns += SECOND
    assert clock.device_us(now_ns) == pytest.approx(device.us(now_ns), abs=10)
    assert device.us(now_ns) < 30_000_000


@given(
    device_us=st.integers(0, DEVICE_CLOCK_MODULUS_US - 1),
    age=st.integers(-80_000, 1_200_000),
    error_us=st.floats(-1_000, 1_000),
)
def test_age_from_the_low_bits(device_us, age, error_us):
    modulus_us = 65_536 * 20
    sample_us = (device_us - age) % modulus_us
    assert age_us(sample_us, modulus_us, device_us + error_us) == pytest.approx(age + error_us, abs=1e-3)
