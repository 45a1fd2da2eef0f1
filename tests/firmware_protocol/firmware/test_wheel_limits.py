import math

import pytest
from hypothesis import strategies as st

from firmware_protocol import _firmware
from tests.tables import examples

ffi, lib = _firmware.ffi, _firmware.lib
speeds = st.floats(-1e6, 1e6, width=32)
limits = st.floats(0.125, 100.0, width=32)


def wheels(left, right):
    return ffi.new("disco_wheels_t *", (left, right))[0]


@examples(quick=60, every=100, left=speeds, right=speeds, limit=limits)
def test_clamped_speed_is_within_the_limit_and_keeps_the_ratio(left, right, limit):
    clamped = lib.disco_clamp_speed(wheels(left, right), limit)
    assert max(abs(clamped.left), abs(clamped.right)) <= limit
    assert clamped.left * right == pytest.approx(clamped.right * left, rel=1e-5, abs=1e-3)
    if max(abs(left), abs(right)) <= limit:
        assert (clamped.left, clamped.right) == (left, right)
    else:
        assert max(abs(clamped.left), abs(clamped.right)) == pytest.approx(limit, rel=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_not_a_number_is_standstill(bad):
    for pair in ((bad, 1.0), (1.0, bad), (bad, bad)):
        clamped = lib.disco_clamp_speed(wheels(*pair), 8.0)
        assert (clamped.left, clamped.right) == (0.0, 0.0)


moderate = st.floats(-100.0, 100.0, width=32)


@examples(
    quick=60, every=100, left=moderate, right=moderate, to_left=moderate, to_right=moderate, step=st.floats(0.001, 10.0)
)
def test_approach_keeps_to_the_step_and_to_the_straight_line(left, right, to_left, to_right, step):
    result = lib.disco_approach(wheels(left, right), wheels(to_left, to_right), step)
    moved = (result.left - left, result.right - right)
    to_target = (to_left - left, to_right - right)
    assert max(map(abs, moved)) <= step * (1 + 1e-5) + 1e-5
    assert moved[0] * to_target[1] == pytest.approx(moved[1] * to_target[0], rel=1e-3, abs=0.01)
    if max(map(abs, to_target)) <= step:
        assert (result.left, result.right) == (to_left, to_right)


@pytest.mark.parametrize("target", [(3.0, 3.0), (1.0, -2.0)], ids=["elsewhere", "at the target"])
def test_approach_with_no_step_stays_and_is_a_number(target):
    result = lib.disco_approach(wheels(1.0, -2.0), wheels(*target), 0.0)
    assert (result.left, result.right) == (1.0, -2.0)


def test_largest_and_equal():
    assert lib.disco_largest(wheels(-3.0, 2.0)) == 3.0
    assert lib.disco_largest(wheels(math.nan, 2.0)) == math.inf
    assert lib.disco_wheels_equal(wheels(1.0, 2.0), wheels(1.0, 2.0))
    assert not lib.disco_wheels_equal(wheels(1.0, 2.0), wheels(2.0, 2.0))
    assert not lib.disco_wheels_equal(wheels(1.0, 2.0), wheels(1.0, 1.0))
