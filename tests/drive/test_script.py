"""Scripts as functions of time, and the room they take."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.config import Robot
from disco_hw.drive.script import Manoeuvre, Script, in_table, room_needed

ROBOT = Robot(name="square", wheel_radius_m=0.1, axial_distance_m=0.5, ticks_per_rev=1000, max_wheel_speed_rad_s=10.0)


def manoeuvre(name, duration_s, left, right):
    return Manoeuvre(name, f"for {name}", duration_s, lambda t_s: (left + t_s, right))


SCRIPT = Script("two", (manoeuvre("first", 1.0, 10.0, 1.0), manoeuvre("second", 2.0, 20.0, 2.0)))


def test_each_manoeuvre_has_its_own_time():
    assert SCRIPT.duration_s == 3.0
    assert SCRIPT.at(0.5) == (10.5, 1.0)
    assert SCRIPT.at(1.0) == (20.0, 2.0)
    assert SCRIPT.at(2.5) == (21.5, 2.0)
    assert SCRIPT.place(2.5)[1] == 1.0


def test_before_and_after_it_stands():
    assert SCRIPT.at(-0.001) == (0.0, 0.0)
    assert SCRIPT.at(3.0) == (0.0, 0.0)


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


def test_room_of_a_straight_and_of_a_circle():
    straight = room_needed(lambda _t: (5.0, 5.0), 4.0, ROBOT)
    assert straight.x_m == pytest.approx((0.0, 2.0))
    assert straight.y_m == (0.0, 0.0)
    # v = 0.5 m/s and 1 rad/s: a circle of radius 0.5 m to the left.
    circle = room_needed(lambda _t: (2.5, 7.5), 2.0 * math.pi, ROBOT)
    assert circle.x_m == pytest.approx((-0.5, 0.5), abs=1e-3)
    assert circle.y_m == pytest.approx((0.0, 1.0), abs=1e-3)
    assert circle.describe().startswith("about 0.5 m ahead, 0.5 m behind, 1.0 m to the left and 0.0 m to the right")


def test_the_table_says_when_what_and_what_for():
    assert [line.split() for line in in_table(SCRIPT)] == [
        ["0.0", "s", "first", "for", "first"],
        ["1.0", "s", "second", "for", "second"],
    ]
