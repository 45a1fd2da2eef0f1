"""Which headings are left out, and when they are used again."""

import math

import pytest

from disco_hw.estimation.heading_watch import Heading, HeadingWatch
from drivers.types import PoseSample

PER_RAD = 0.15


def pose(yaw_rad, std_rad=0.02, x_m=1.0, source=0):
    return PoseSample(0, 0, x_m, 2.0, yaw_rad, 0.01, std_rad, source=source)


def kept(watch, yaws, turn_each_rad=0.02, start_rad=0.0):
    """Whether the heading of each pose is kept while the wheels turn the robot by so much between two."""
    return [
        watch.screen(pose(yaw), (start_rad + turn_each_rad * k) / PER_RAD, PER_RAD)[0].has_heading
        for k, yaw in enumerate(yaws)
    ]


def test_a_heading_that_turns_as_the_wheels_do_and_one_that_stands_with_the_robot_are_kept():
    watch = HeadingWatch(["udp"])
    assert all(kept(watch, [0.02 * k for k in range(200)]))
    assert all(kept(watch, [1.0] * 500, turn_each_rad=0.0))
    assert watch.current == (Heading.MEASURED,)
    assert watch.new_messages() == []


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_one_that_repeats_itself_while_the_wheels_turn_is_left_out_until_it_has_moved_again(sign):
    watch = HeadingWatch(["udp"])
    turning = [0.02 * k for k in range(50)]
    assert all(kept(watch, turning))
    found = kept(watch, [1.0] * 50, turn_each_rad=sign * 0.02)
    assert found == [True] * found.index(False) + [False] * (50 - found.index(False))
    assert 5 <= found.index(False) <= 9
    assert watch.current == (Heading.FROZEN,)
    (message,) = watch.new_messages()
    assert message.startswith("udp: the heading stays at 1.00 rad while the wheels turn the robot by 0.1")
    again = kept(watch, [1.0 + 0.02 * k for k in range(1, 40)])
    assert again[:9] == [False] * 9
    assert all(again[9:])
    assert watch.new_messages() == ["udp: its headings are used again"]


def test_one_that_never_was_another_is_no_measurement_from_the_first_on():
    watch = HeadingWatch(["udp"])
    seen = [watch.screen(pose(0.0), 0.02 * k / PER_RAD, PER_RAD) for k in range(40)]
    assert [never for _, never in seen].count(True) == 1
    first_without = [one.has_heading for one, _ in seen].index(False)
    never_at = [never for _, never in seen].index(True)
    assert 0.15 <= 0.02 * first_without < 0.19
    assert 0.35 <= 0.02 * never_at < 0.39


@pytest.mark.parametrize("std_rad", [-1.0, 31.7, math.nan, math.inf])
def test_a_deviation_that_says_nothing_leaves_the_heading_out(std_rad):
    watch = HeadingWatch(["udp"])
    found, never_measured = watch.screen(pose(0.5, std_rad), 0.0, PER_RAD)
    assert (found.x_m, found.y_m, found.has_heading, never_measured) == (1.0, 2.0, False, False)
    (message,) = watch.new_messages()
    assert message.endswith("only the positions are used")


def test_the_position_is_then_that_of_the_sensor():
    """As it was before the convention took the tracked point from it by a heading that is none."""
    offset, yaw = (0.3, -0.1), 2.0
    watch = HeadingWatch(["udp"], [offset])
    x, y = 5.0, -4.0
    ahead = (0.3 * math.cos(yaw) + 0.1 * math.sin(yaw), 0.3 * math.sin(yaw) - 0.1 * math.cos(yaw))
    sample = PoseSample(0, 0, x - ahead[0], y - ahead[1], yaw, math.hypot(0.01, 0.3162277660168379 * 40.0), 40.0)
    found, _ = watch.screen(sample, 0.0, PER_RAD)
    assert (found.x_m, found.y_m) == pytest.approx((x, y))
    assert (found.lever_x_m, found.lever_y_m) == offset
    assert found.position_std_m == pytest.approx(0.01, rel=1e-3)


def test_sources_are_followed_each_by_itself():
    watch = HeadingWatch(["robot", "nmea"])
    for k in range(40):
        assert watch.screen(pose(0.02 * k), 0.02 * k / PER_RAD, PER_RAD)[0].has_heading
        watch.screen(pose(1.0, source=1), 0.02 * k / PER_RAD, PER_RAD)
    assert watch.current == (Heading.MEASURED, Heading.FROZEN)


def test_no_heading_is_measured_where_no_source_that_sends_has_one():
    watch = HeadingWatch(["natnet", "nmea"])
    assert not watch.measures_none
    watch.screen(pose(math.nan, math.nan, source=1), 0.0, PER_RAD)
    assert watch.measures_none
    assert all(kept(watch, [0.02 * k for k in range(50)]))
    assert not watch.measures_none
    kept(watch, [1.0] * 50)
    assert watch.current == (Heading.FROZEN, Heading.NONE)
    assert watch.measures_none
