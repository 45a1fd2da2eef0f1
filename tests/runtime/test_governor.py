import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.runtime.pipeline import Governed, Governor, Limited, WheelLimits

LIMITS = WheelLimits(max_speed_rad_s=8.0, max_acceleration_rad_s2=20.0, max_deceleration_rad_s2=30.0)
PERIOD_S = 0.02
ANYTHING = st.floats(allow_nan=True, allow_infinity=True)
REACHABLE = st.floats(-8.0, 8.0)


def governor_at(left, right):
    governor = Governor(LIMITS, PERIOD_S)
    for _ in range(100):
        governor.step(left, right, PERIOD_S)
    return governor


def speed_change_allowed(start, end, dt_s):
    """Whether a wheel can go from start to end in dt_s: first down to standstill, then up again."""
    if start * end >= 0.0 and abs(end) >= abs(start):
        needed_s = (abs(end) - abs(start)) / LIMITS.max_acceleration_rad_s2
    elif start * end >= 0.0:
        needed_s = (abs(start) - abs(end)) / LIMITS.max_deceleration_rad_s2
    else:
        needed_s = abs(start) / LIMITS.max_deceleration_rad_s2 + abs(end) / LIMITS.max_acceleration_rad_s2
    return needed_s <= dt_s + 1e-12


@given(st.lists(st.tuples(ANYTHING, ANYTHING, ANYTHING), max_size=60))
def test_no_input_ever_gets_a_command_beyond_the_limits(inputs):
    governor = Governor(LIMITS, PERIOD_S)
    before = Governed(0.0, 0.0, Limited.NONE)
    for left, right, dt_s in inputs:
        after = governor.step(left, right, dt_s)
        usable_dt_s = 0.0 if math.isnan(dt_s) else min(max(dt_s, 0.0), 1.5 * PERIOD_S)
        assert max(abs(after.left_rad_s), abs(after.right_rad_s)) <= LIMITS.max_speed_rad_s + 1e-12
        assert speed_change_allowed(before.left_rad_s, after.left_rad_s, usable_dt_s)
        assert speed_change_allowed(before.right_rad_s, after.right_rad_s, usable_dt_s)
        before = after


@given(REACHABLE, REACHABLE, REACHABLE, REACHABLE)
def test_every_reachable_target_is_reached_exactly_and_then_not_limited(left0, right0, left, right):
    governor = governor_at(left0, right0)
    for _ in range(100):
        governed = governor.step(left, right, PERIOD_S)
    assert governed == Governed(left, right, Limited.NONE)


@given(REACHABLE, REACHABLE, REACHABLE, REACHABLE)
def test_the_change_keeps_its_direction_and_at_least_one_wheel_uses_its_limit(left0, right0, left, right):
    governor = governor_at(left0, right0)
    governed = governor.step(left, right, PERIOD_S)
    moved = (governed.left_rad_s - left0, governed.right_rad_s - right0)
    requested = (left - left0, right - right0)
    assert moved[0] * requested[1] - moved[1] * requested[0] == pytest.approx(0.0, abs=1e-9)
    assert moved[0] * requested[0] + moved[1] * requested[1] >= 0.0
    if Limited.ACCELERATION in governed.limited:
        assert not (
            speed_change_allowed(left0, left0 + 1.01 * moved[0], PERIOD_S)
            and speed_change_allowed(right0, right0 + 1.01 * moved[1], PERIOD_S)
        )


@given(st.floats(-20.0, 20.0) | st.floats(-1e6, 1e6), st.floats(-20.0, 20.0) | st.floats(-1e6, 1e6))
def test_speed_limit_keeps_the_curvature(left, right):
    governed = governor_at(left, right).step(left, right, PERIOD_S)
    assert governed.left_rad_s * right == pytest.approx(governed.right_rad_s * left, rel=1e-9, abs=1e-9)
    too_fast = max(abs(left), abs(right)) > LIMITS.max_speed_rad_s
    assert (Limited.SPEED in governed.limited) == too_fast
    if too_fast:
        assert max(abs(governed.left_rad_s), abs(governed.right_rad_s)) == pytest.approx(LIMITS.max_speed_rad_s)


@given(st.lists(st.floats(0.0, 1.0), max_size=20))
def test_zero_stays_zero(durations_s):
    governor = Governor(LIMITS, PERIOD_S)
    for dt_s in durations_s:
        governed = governor.step(0.0, 0.0, dt_s)
        assert (governed.left_rad_s, governed.right_rad_s) == (0.0, 0.0)


@given(REACHABLE, REACHABLE, st.sampled_from([math.nan, math.inf, -math.inf]), st.booleans())
def test_a_command_that_is_not_finite_ramps_to_zero_and_is_reported(left0, right0, bad, bad_is_left):
    governor = governor_at(left0, right0)
    reference = governor_at(left0, right0)
    for _ in range(30):
        governed = governor.step(bad, 1.0, PERIOD_S) if bad_is_left else governor.step(1.0, bad, PERIOD_S)
        ramp = reference.step(0.0, 0.0, PERIOD_S)
        assert (governed.left_rad_s, governed.right_rad_s) == (ramp.left_rad_s, ramp.right_rad_s)
        assert Limited.NOT_FINITE in governed.limited
    assert (governed.left_rad_s, governed.right_rad_s) == (0.0, 0.0)


def test_acceleration_from_standstill_and_deceleration_use_their_own_limits():
    governor = Governor(LIMITS, PERIOD_S)
    governed = governor.step(8.0, 4.0, PERIOD_S)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((0.4, 0.2))
    assert governed.limited == Limited.ACCELERATION
    governor = governor_at(8.0, 4.0)
    governed = governor.step(0.0, 0.0, PERIOD_S)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((7.4, 3.7))


def test_reversing_brakes_to_standstill_first_and_accelerates_with_what_is_left():
    governor = governor_at(0.3, 0.3)
    # 0.01 s brake 0.3 rad/s away, the other 0.01 s give 0.2 rad/s backwards.
    assert governor.step(-8.0, -8.0, PERIOD_S).left_rad_s == pytest.approx(-0.2)


@pytest.mark.parametrize(
    ("elapsed_s", "used_s"),
    [(0.031, 0.03), (0.2, 0.03), (1e9, 0.03), (math.inf, 0.03), (-0.02, 0.0), (math.nan, 0.0), (-math.inf, 0.0)],
)
def test_a_late_tick_allows_one_and_a_half_periods_and_time_that_is_none_no_change(elapsed_s, used_s):
    governed = Governor(LIMITS, PERIOD_S).step(8.0, 8.0, elapsed_s)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((20.0 * used_s,) * 2, abs=0.0)
    assert Limited.PERIOD in governed.limited


def test_reset_starts_again_from_standstill():
    governor = governor_at(8.0, 8.0)
    governor.reset()
    governed = governor.step(8.0, 8.0, PERIOD_S)
    assert (governed.left_rad_s, governed.right_rad_s) == pytest.approx((0.4, 0.4))


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("field", ["max_speed_rad_s", "max_acceleration_rad_s2", "max_deceleration_rad_s2"])
def test_limits_cannot_be_switched_off(field, bad):
    with pytest.raises(ValueError, match=field):
        replace(LIMITS, **{field: bad})


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_period_must_be_positive(bad):
    with pytest.raises(ValueError, match="period_s"):
        Governor(LIMITS, bad)
