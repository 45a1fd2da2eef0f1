"""Wheel samples to readings: refusals, gaps, restarted counters."""

import itertools
import math

import pytest
from hypothesis import strategies as st

from disco_hw.estimation.odometry import MAX_WHEEL_SPEED_RAD_S, WheelReading, WheelReason, WheelTracker
from drivers.types import WheelSample
from tests.tables import examples

MS = 1_000_000


def sample(t_ms, left=0.0, right=0.0, speeds=(0.0, 0.0), received_ms=None):
    received_ms = t_ms if received_ms is None else received_ms
    return WheelSample(t_ms * MS, received_ms * MS, left, right, *speeds)


def test_samples_become_readings():
    tracker = WheelTracker()
    assert tracker.add_sample(sample(10, 1.0, 2.0, (0.5, 0.6))) == WheelReading(10 * MS, 1.0, 2.0, 0.5, 0.6)
    assert tracker.add_sample(sample(20, 1.1, 2.2, (0.5, 0.6))) == WheelReading(20 * MS, 1.1, 2.2, 0.5, 0.6)


@pytest.mark.parametrize("position", range(4))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_not_finite_is_refused(position, value):
    values = [0.0] * 4
    values[position] = value
    assert WheelTracker().add_sample(sample(10, values[0], values[1], values[2:])) is WheelReason.NOT_FINITE


@pytest.mark.parametrize(("angle", "speed"), [(1e10, 0.0), (-1e300, 0.0), (0.0, 132.0), (0.0, -1e300)])
def test_absurd_values_are_refused(angle, speed):
    assert WheelTracker().add_sample(sample(10, angle, 0.0, (0.0, speed))) is WheelReason.OUT_OF_RANGE


def test_a_stamp_ahead_of_its_reception_does_not_lock_out_what_follows():
    tracker = WheelTracker()
    tracker.add_sample(sample(0))
    assert tracker.add_sample(sample(3_600_000, received_ms=10)) is WheelReason.FUTURE
    assert isinstance(tracker.add_sample(sample(60, received_ms=20)), WheelReading)


def test_out_of_order_and_repeated_samples_are_refused():
    tracker = WheelTracker()
    tracker.add_sample(sample(20))
    assert tracker.add_sample(sample(10)) is WheelReason.OUT_OF_ORDER
    assert tracker.add_sample(sample(20)) is WheelReason.OUT_OF_ORDER
    assert isinstance(tracker.add_sample(sample(21)), WheelReading)


def test_lost_samples_lose_no_distance():
    tracker = WheelTracker()
    tracker.add_sample(sample(0))
    reading = tracker.add_sample(sample(3000, 25.0, 30.0))
    assert (reading.left_rad, reading.right_rad, reading.after_gap, reading.restarted) == (25.0, 30.0, True, False)
    assert not tracker.add_sample(sample(3100, 25.0, 30.0)).after_gap


def test_a_restarted_counter_goes_on_where_it_was():
    tracker = WheelTracker()
    tracker.add_sample(sample(0, 500.0, 400.0))
    reading = tracker.add_sample(sample(10, 0.0, 0.0))
    assert (reading.left_rad, reading.right_rad, reading.restarted) == (500.0, 400.0, True)
    reading = tracker.add_sample(sample(20, 0.25, 0.5))
    assert (reading.left_rad, reading.right_rad, reading.restarted) == (500.25, 400.5, False)


def test_the_bound_of_a_jump_grows_with_the_time_and_allows_for_jitter():
    bound_rad = MAX_WHEEL_SPEED_RAD_S * 0.01 + 1.0
    for turn, restarted in ((bound_rad - 0.01, False), (bound_rad + 0.01, True), (-bound_rad - 0.01, True)):
        tracker = WheelTracker()
        tracker.add_sample(sample(0))
        assert tracker.add_sample(sample(10, 0.0, turn)).restarted is restarted


numbers = st.floats(allow_nan=True, allow_infinity=True)


@examples(
    quick=30, every=100, values=st.lists(st.tuples(st.integers(-(2**63), 2**63), numbers, numbers, numbers, numbers))
)
def test_any_stream_gives_finite_readings_in_order(values):
    tracker, readings = WheelTracker(), []
    for t_ns, *rest in values:
        reading = tracker.add_sample(WheelSample(t_ns, t_ns, *rest))
        if isinstance(reading, WheelReading):
            readings.append(reading)
    for before, after in itertools.pairwise(readings):
        assert after.t_ns > before.t_ns
        seconds = (after.t_ns - before.t_ns) * 1e-9
        assert abs(after.left_rad - before.left_rad) <= MAX_WHEEL_SPEED_RAD_S * seconds + 1.0 + 1e-6
        assert math.isfinite(after.left_rad + after.right_rad + after.left_speed_rad_s + after.right_speed_rad_s)
