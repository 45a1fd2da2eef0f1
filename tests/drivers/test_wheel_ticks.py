import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.wheel_ticks import REANCHOR_AFTER, SLACK_TICKS, SPEED_MARGIN, TICKS_MODULUS, WheelTicks

TICKS_PER_REV = 2048
PER_TICK = 2 * math.pi / TICKS_PER_REV
PERIOD_US = 10_000
MAX_SPEED = 8.0
LIMIT = int(SPEED_MARGIN * MAX_SPEED * PERIOD_US * 1e-6 / PER_TICK + SLACK_TICKS)


def wheel_ticks():
    return WheelTicks(TICKS_PER_REV, MAX_SPEED)


@given(
    start=st.tuples(st.integers(0, TICKS_MODULUS - 1), st.integers(0, TICKS_MODULUS - 1)),
    steps=st.lists(st.tuples(st.integers(-LIMIT, LIMIT), st.integers(-LIMIT, LIMIT)), max_size=60),
)
def test_plausible_steps_add_up_wherever_the_ring_is_and_whichever_way_it_turns(start, steps):
    ticks = wheel_ticks()
    left, right = start
    ticks.update(left, right, 0)
    for number, (step_left, step_right) in enumerate(steps, 1):
        left, right = left + step_left, right + step_right
        angles = ticks.update(left % TICKS_MODULUS, right % TICKS_MODULUS, number * PERIOD_US)
        assert angles == ((left - start[0]) * PER_TICK, (right - start[1]) * PER_TICK)


@pytest.mark.parametrize("step", [LIMIT, -LIMIT])
def test_once_round_the_whole_ring(step):
    ticks = wheel_ticks()
    count = TICKS_MODULUS // abs(step) + 10
    for number in range(count + 1):
        angles = ticks.update(number * step % TICKS_MODULUS, 0, number * PERIOD_US)
    assert angles == (count * step * PER_TICK, 0.0)


@given(
    jump=st.integers(LIMIT + 1, TICKS_MODULUS - LIMIT - 1),
    start=st.integers(0, TICKS_MODULUS - 1),
    wheel=st.sampled_from([0, 1]),
)
def test_a_jump_is_dropped_and_leaves_no_trace(jump, start, wheel):
    ticks = wheel_ticks()
    ticks.update(start, start, 0)
    reading = [start, start]
    reading[wheel] = (start + jump) % TICKS_MODULUS
    assert ticks.update(*reading, PERIOD_US) is None
    back = ticks.update((start + 1) % TICKS_MODULUS, (start - 1) % TICKS_MODULUS, PERIOD_US)
    assert back == (PER_TICK, -PER_TICK)


def test_counters_that_stay_elsewhere_are_believed_after_a_while_without_motion():
    ticks = wheel_ticks()
    ticks.update(100, 100, 0)
    ticks.update(110, 90, PERIOD_US)
    for number in range(2, REANCHOR_AFTER + 1):
        assert ticks.update(5_000_000 + number, 0, number * PERIOD_US) is None
    assert ticks.update(5_000_010, 0, 6 * PERIOD_US) == (10 * PER_TICK, -10 * PER_TICK)
    assert ticks.update(5_000_011, 1, 7 * PERIOD_US) == (11 * PER_TICK, -9 * PER_TICK)


def test_only_readings_in_a_row_make_the_counters_believed():
    ticks = wheel_ticks()
    ticks.update(0, 0, 0)
    for number in range(1, 20):
        odd = number % REANCHOR_AFTER
        angles = ticks.update(8_000_000 if odd else 0, 0, number * PERIOD_US)
        assert angles == (None if odd else (0.0, 0.0))


def test_more_time_since_the_last_good_reading_allows_more_motion():
    ticks = wheel_ticks()
    ticks.update(0, 0, 0)
    assert ticks.update(3 * LIMIT, 0, PERIOD_US) is None
    assert ticks.update(3 * LIMIT, 0, 4 * PERIOD_US) == (3 * LIMIT * PER_TICK, 0.0)


def test_after_forgetting_the_angles_go_on_from_where_they_are():
    ticks = wheel_ticks()
    ticks.update(0, 0, 0)
    ticks.update(20, 10, PERIOD_US)
    ticks.forget()
    assert ticks.update(9_000_000, 77, 2 * PERIOD_US) == (20 * PER_TICK, 10 * PER_TICK)


def test_a_start_is_added():
    ticks = WheelTicks(TICKS_PER_REV, MAX_SPEED, start=(3.0, -4.0))
    assert ticks.update(7, 7, 0) == ticks.angles == (3.0, -4.0)
