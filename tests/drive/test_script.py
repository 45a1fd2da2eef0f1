"""Scripts and their pieces as functions of time, the room they take, and what counts as a wheel's limit."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.config import Robot
from disco_hw.drive.script import REST_S, Manoeuvre, Pieces, ReachedLimits, Script, in_table, room_needed

ROBOT = Robot(name="square", wheel_radius_m=0.1, axial_distance_m=0.5, ticks_per_rev=1000, max_wheel_speed_rad_s=10.0)


def manoeuvre(name, duration_s, left, right):
    return Manoeuvre(name, f"for {name}", duration_s, lambda t_s: (left + t_s, right))


SCRIPT = Script("two", (manoeuvre("first", 1.0, 10.0, 1.0), manoeuvre("second", 2.0, 20.0, 2.0)))


def test_each_manoeuvre_has_its_own_time():
    assert SCRIPT.duration_s == 3.0
    assert SCRIPT.at(-0.001) == SCRIPT.at(3.0) == (0.0, 0.0), "before and after them it stands"
    assert SCRIPT.at(0.5) == (10.5, 1.0)
    assert SCRIPT.at(1.0) == (20.0, 2.0)
    assert SCRIPT.at(2.5) == (21.5, 2.0)
    assert SCRIPT.place(2.5)[1] == 1.0


def test_a_script_needs_a_manoeuvre():
    with pytest.raises(ValueError, match="at least one"):
        Script("none", ())


@given(st.floats(0.01, 5.0), st.floats(-1.0, 6.0))
def test_a_cut_script_is_the_same_until_the_cut(seconds, t_s):
    cut = SCRIPT.cut(seconds)
    assert cut.duration_s == pytest.approx(min(seconds, 3.0))
    if t_s < min(seconds, 3.0) - 1e-9:
        assert cut.at(t_s) == SCRIPT.at(t_s)
    elif t_s > min(seconds, 3.0) + 1e-9:
        assert cut.at(t_s) == (0.0, 0.0)


def held(duration_s, left, right):
    return Script("held", (Manoeuvre("hold", "", duration_s, lambda _t_s: (left, right)),))


def test_room_of_a_straight_and_of_a_circle():
    straight = room_needed(held(4.0, 5.0, 5.0), ROBOT)
    assert straight.x_m == pytest.approx((0.0, 2.0))
    assert straight.y_m == (0.0, 0.0)
    # v = 0.5 m/s and 1 rad/s: a circle of radius 0.5 m to the left.
    circle = room_needed(held(2.0 * math.pi, 2.5, 7.5), ROBOT)
    assert circle.x_m == pytest.approx((-0.5, 0.5), abs=1e-3)
    assert circle.y_m == pytest.approx((0.0, 1.0), abs=1e-3)
    assert circle.describe().startswith("about 0.5 m ahead, 0.5 m behind, 1.0 m to the left and 0.0 m to the right")


def test_the_tracked_point_behind_the_centre_of_rotation_needs_room_in_a_turn_on_the_spot():
    # 1 rad/s about a point 0.2 m ahead.
    room = room_needed(held(2.0 * math.pi, -2.5, 2.5), msgspec.structs.replace(ROBOT, x_icr_m=0.2))
    assert room.x_m == pytest.approx((0.0, 0.4), abs=1e-3)
    assert room.y_m == pytest.approx((-0.2, 0.2), abs=1e-3)


def test_the_room_has_the_way_to_a_standstill_after_a_script_that_is_broken_off():
    slow = msgspec.structs.replace(ROBOT, max_wheel_acceleration_rad_s2=2.0)
    # 0.3 m of speeding up to 0.6 m/s in 3 s, cut after the first of them at 0.2 m/s: 0.1 m, and as much to stop.
    room = room_needed(held(3.0, 6.0, 6.0).cut(1.0), slow)
    assert room.x_m == pytest.approx((0.0, 0.2), abs=0.01)


def test_the_table_says_when_what_and_what_for():
    assert [line.split() for line in in_table(SCRIPT)] == [
        ["0.0", "s", "first", "for", "first"],
        ["1.0", "s", "second", "for", "second"],
    ]


PIECES = Pieces(5.0)


@pytest.mark.parametrize(
    ("forward", "turn", "wheels"),
    [(1.0, 0.0, (5.0, 5.0)), (0.0, 0.4, (-2.0, 2.0)), (-0.5, 0.2, (-3.5, -1.5)), (0.5, -0.5, (5.0, 0.0))],
)
def test_shares_are_of_the_largest_speed_and_left_turns_have_the_right_wheel_ahead(forward, turn, wheels):
    manoeuvre = PIECES.hold("name", "purpose", 2.0, forward, turn)
    assert manoeuvre.wheels(0.0) == pytest.approx(wheels)
    assert manoeuvre.wheels(1.9) == pytest.approx(wheels)
    assert (manoeuvre.name, manoeuvre.purpose, manoeuvre.duration_s) == ("name", "purpose", 2.0)


def test_a_played_piece_follows_its_profile():
    played = PIECES.play("name", "purpose", 2.0, lambda t_s: (0.1 * t_s, 0.0))
    assert played.wheels(0.0) == (0.0, 0.0)
    assert played.wheels(2.0) == pytest.approx((1.0, 1.0))


def test_each_piece_is_followed_by_a_rest():
    found = PIECES.each("purpose", ("one", 1.0, 0.5, 0.0), ("two", 3.0, 0.0, 0.5))
    assert [part.name for part in found] == ["one", "rest", "two", "rest"]
    assert [part.duration_s for part in found] == [1.0, REST_S, 3.0, REST_S]
    assert found[1].wheels(0.3) == (0.0, 0.0)


def limits(**observed):
    """Manoeuvres with their samples (commanded, measured) of the left wheel; the right one does as commanded."""
    found = ReachedLimits()
    for manoeuvre, samples in observed.items():
        for commanded, measured in samples:
            found.observe(manoeuvre, (commanded, commanded), (measured, commanded))
    return found


def test_what_was_reached_is_the_limit_each_way():
    found = limits(ahead=[(6.0, 4.5)] * 3, back=[(-6.0, -3.0)] * 3)
    assert found.within((6.0, 6.0)) == (4.5, 6.0)
    assert found.within((-6.0, -6.0)) == (-3.0, -6.0)
    assert found.within((2.0, 0.0)) == (1.5, 0.0)
    assert found.describe() == "found: left -3.0 to +4.5, right -6.0 to +6.0 rad/s"


def test_the_manoeuvre_where_it_reached_least_counts():
    assert limits(straight=[(6.0, 6.0)] * 9, turning=[(6.0, 3.0)]).within((6.0, 0.0))[0] == 3.0


def test_single_bad_samples_do_not_count():
    assert limits(ahead=[(6.0, 4.5)] * 4 + [(6.0, 0.0)]).within((6.0, 0.0))[0] == 4.5


@pytest.mark.parametrize(("measured", "limit"), [(5.8, 6.0), (7.0, 6.0), (-1.0, 0.0)])
def test_close_is_reached_and_the_wrong_way_is_nothing(measured, limit):
    assert limits(ahead=[(6.0, measured)]).within((6.0, 0.0))[0] == limit


def test_a_measurement_that_is_no_number_limits_nothing():
    assert limits(ahead=[(6.0, float("nan"))]).within((6.0, 0.0))[0] == 6.0
