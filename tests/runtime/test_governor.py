"""What the governor reports, and settings that it refuses; how it moves, test_governor_model.py compares."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.runtime.pipeline import Governed, Governor, Limited, WheelLimits

LIMITS = WheelLimits(max_speed_rad_s=8.0, max_acceleration_rad_s2=20.0, max_deceleration_rad_s2=30.0)
PERIOD_S = 0.02
REACHABLE = st.floats(-8.0, 8.0)


def governor_at(left, right):
    governor = Governor(LIMITS, PERIOD_S)
    for _ in range(100):
        governor.step(left, right, PERIOD_S)
    return governor


@given(REACHABLE, REACHABLE, REACHABLE, REACHABLE)
def test_every_reachable_target_is_reached_exactly_and_then_not_limited(left0, right0, left, right):
    governor = governor_at(left0, right0)
    for _ in range(100):
        governed = governor.step(left, right, PERIOD_S)
    assert governed == Governed(left, right, Limited.NONE)


def test_acceleration_from_standstill_and_deceleration_use_their_own_limits():
    governor = Governor(LIMITS, PERIOD_S)
    governed = governor.step(8.0, 4.0, PERIOD_S)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((0.4, 0.2))
    assert governed.limited == Limited.ACCELERATION
    governor = governor_at(8.0, 4.0)
    governed = governor.step(0.0, 0.0, PERIOD_S)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((7.4, 3.7))


@pytest.mark.parametrize(
    ("elapsed_s", "used_s"),
    [(0.031, 0.03), (0.2, 0.03), (1e9, 0.03), (math.inf, 0.03), (-0.02, 0.0), (math.nan, 0.0), (-math.inf, 0.0)],
)
def test_a_late_tick_allows_one_and_a_half_periods_and_time_that_is_none_no_change(elapsed_s, used_s):
    governed = Governor(LIMITS, PERIOD_S).step(8.0, 8.0, elapsed_s)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((20.0 * used_s,) * 2, abs=0.0)
    assert Limited.PERIOD in governed.limited


@pytest.mark.parametrize(("left", "right"), [(-4.0, 4.0), (2.0, 8.0), (-7.0, 1.0)])
def test_wheels_that_may_differ_by_less_are_scaled_by_one_factor(left, right):
    governor = Governor(replace(LIMITS, max_difference_rad_s=3.0), PERIOD_S)
    for _ in range(100):
        governed = governor.step(left, right, PERIOD_S)
    assert governed.limited == Limited.SPEED
    assert abs(governed.right_rad_s - governed.left_rad_s) == pytest.approx(3.0)
    assert governed.left_rad_s * right == pytest.approx(governed.right_rad_s * left)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan])
def test_a_difference_that_no_wheels_can_have_is_no_limit_of_it(bad):
    with pytest.raises(ValueError, match="max_difference_rad_s"):
        replace(LIMITS, max_difference_rad_s=bad)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("field", ["max_speed_rad_s", "max_acceleration_rad_s2", "max_deceleration_rad_s2"])
def test_limits_cannot_be_switched_off(field, bad):
    with pytest.raises(ValueError, match=field):
        replace(LIMITS, **{field: bad})


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_period_must_be_positive(bad):
    with pytest.raises(ValueError, match="period_s"):
        Governor(LIMITS, bad)
