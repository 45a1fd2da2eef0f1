"""Hairpins: refused by line and remedy, and nothing else that turns is."""

import math

import numpy as np
import pytest

from disco_hw.errors import InputError
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.tasks.line import PathTable, load_waypoints
from disco_hw.tasks.line.course import hairpin
from tests.runtime.path_robot import ROBOTS, path_robot

X_ICR_M = 0.238


def way(*legs):
    """Places along legs of a length (m), each with the turn after it (degrees)."""
    places, heading = [(0.0, 0.0)], 0.0
    for length_m, turn in legs:
        x, y = places[-1]
        places.append((x + length_m * math.cos(heading), y + length_m * math.sin(heading)))
        heading += math.radians(turn)
    return np.array(places)


def found(places):
    return hairpin(PathTable(places), X_ICR_M)


# Where the planner stopped for good in simulated drives (docs/paths.md).
STUCK = [
    *(((90, 90), apart_m) for apart_m in (0.05, 0.1, 0.15, 0.2)),
    *(((110, 110), apart_m) for apart_m in (0.15, 0.3)),
    *(((120, 120), apart_m) for apart_m in (0.3, 0.35, 0.4)),
    *(((130, 130), apart_m) for apart_m in (0.05, 0.1, 0.2, 0.25)),
    *(((150, 150), apart_m) for apart_m in (0.1, 0.15)),
    *(((130, -130), apart_m) for apart_m in (0.15, 0.35, 0.4, 0.5, 0.7)),
    ((150, -150), 0.5),
]


@pytest.mark.parametrize(("turns", "apart_m"), STUCK)
def test_turns_before_which_it_stopped_for_good_are_found(turns, apart_m):
    first, second = turns
    places = way((1.0, first), (apart_m, second), (1.0, 0))
    begin_m, end_m, least_m = found(places)
    assert begin_m == pytest.approx(1.0, abs=0.05)
    assert end_m == pytest.approx(1.0 + apart_m, abs=0.05)
    assert least_m > apart_m
    # Wherever they are, and driven the other way as well.
    assert found(places[::-1]) is not None
    assert found(way((2.0, 45), (1.0, first), (apart_m, second), (1.0, 30), (1.0, 0))) is not None


@pytest.mark.parametrize("across_m", [0.06, 0.1, 0.15])
def test_a_narrow_bend_is_found(across_m):
    angle = np.linspace(0.0, np.pi, 20)
    bend = 0.5 * across_m * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    assert found(np.concatenate([[[-1.0, 0.0]], bend, [[-1.0, across_m]]])) is not None
    assert found(np.concatenate([[[-1.0, 0.0]], 4.0 * bend, [[-1.0, 4.0 * across_m]]])) is None


@pytest.mark.parametrize(
    "places",
    [
        way((1.0, 90), (0.3, 90), (1.0, 0)),
        way((1.0, 90), (0.3, -90), (0.3, -90), (0.3, 90), (1.0, 0)),
        way((1.0, 180), (1.0, 180), (1.0, 0)),
        way((1.0, 150), (1.0, -150), (1.0, 0)),
        way((1.0, 180), (1.0, 0)),
        way((1.0, 130), (0.3, 0)),
        way((0.3, -150), (1.0, 0)),
        way((1.0, 90), (0.1, -90), (1.0, 0)),
        way((1.0, 110), (0.15, -110), (1.0, 0)),
        way((1.0, 70), (0.15, 70), (1.0, 0)),
        way((1.0, 120), (1.0, 120), (1.0, 0)),
        way((0.2, 0)),
        np.array([[0.0, 0.0], [1.2, 0.0], [0.0, 0.0]]),
        np.array([[0.0, 0.0], [1.21, 0.0], [0.0, 0.0]]),
    ],
)
def test_what_has_room_or_turns_at_one_place_is_driven(places):
    assert found(places) is None


@pytest.mark.parametrize("heading_rad", np.linspace(-3.0, 3.0, 7))
def test_there_and_back_has_none_whichever_way_it_goes_and_wherever_its_tip_falls(heading_rad):
    for length_m in (1.0, 1.21, 1.215):
        tip = length_m * np.array([math.cos(heading_rad), math.sin(heading_rad)])
        assert found(np.array([[0.0, 0.0], tip, [0.0, 0.0]])) is None
        assert found(np.array([[0.0, 0.0], tip, 0.3 * tip])) is None


def test_places_that_a_hand_recorded_are_no_hairpins():
    rng = np.random.default_rng(1)
    along = np.linspace(0.0, 3.0, 150)
    assert found(np.column_stack([along, np.sin(along)]) + rng.normal(0.0, 0.003, (150, 2))) is None


def test_a_hairpin_across_the_first_way_point_of_a_closed_path_is_found():
    # A strip of 0.2 m, begun in the middle of its short side.
    strip = np.array([[0.0, 0.1], [0.0, 0.2], [1.5, 0.2], [1.5, -0.5], [0.0, -0.5], [0.0, 0.0], [0.0, 0.1]])
    assert found(strip) is None
    narrow = np.array([[0.0, 0.1], [0.0, 0.2], [1.5, 0.2], [2.0, 1.0], [2.5, 0.0], [0.0, 0.0], [0.0, 0.1]])
    begin_m, end_m, _ = found(narrow)
    assert end_m < 0.25 < begin_m


def test_the_shipped_path_and_round_ones_have_none():
    assert found(load_waypoints(ROBOTS / "eight.csv").places_m) is None
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    for radius_m in (0.2, 1.0):
        assert found(radius_m * np.column_stack([np.sin(angle), np.cos(angle)])) is None


def test_a_robot_whose_centre_of_rotation_is_further_away_needs_more_room():
    places = way((1.0, 90), (0.4, 90), (1.0, 0))
    assert hairpin(PathTable(places), 0.3) is None
    for x_icr_m in (0.45, -0.45):
        _, _, least_m = hairpin(PathTable(places), x_icr_m)
        assert least_m == pytest.approx(1.17 * 0.45)


def test_it_is_refused_with_its_lines_and_the_remedy(tmp_path):
    csv = "x_m,y_m\n0,0\n\n1,0\n1,0.2\n0,0.2\n"
    with pytest.raises(InputError) as caught:
        load_setup(path_robot(tmp_path, csv))
    assert str(caught.value) == (
        f"{tmp_path}/path.csv: lines 4 to 5: the path turns twice within 0.28 m, where the robot would leave "
        "it far; leave 0.3 m between the turns, or turn at one way-point"
    )
    assert load_setup(path_robot(tmp_path, csv.replace("0.2", "0.4"))).config.task.points[2] == (1.0, 0.4)


def test_a_path_that_was_driven_is_read_again_as_it_is(tmp_path):
    robot_file = path_robot(tmp_path, "x_m,y_m\n0,0\n1,0\n1,0.2\n0,0.2\n")
    assert len(load_setup(robot_file, path_file=tmp_path / "path.csv").config.task.points) == 4
