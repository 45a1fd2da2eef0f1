"""A path by arc length: followed forwards, at its speed, through crossings and sharp turns, to its end."""

import math

import msgspec
import numpy as np
import pytest

from disco_hw.control import PlannerState, PlanOutcome
from disco_hw.tasks.line import SPACING_M, PathTable, Waypoints, sharp_turns
from tests.tables import thinned
from tests.tasks.costs import path_along
from tests.tasks.drives import SPIN, begin_with, drive, planner_for, plant_at

ANGLE = np.linspace(0.0, 2.0 * np.pi, 200)
EIGHT = Waypoints(np.column_stack([1.5 * np.sin(ANGLE), 0.75 * np.sin(2.0 * ANGLE)]))
CORNER = Waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))


def follow(task, seconds, start):
    """Drive along; returns poses (N, 3), speeds (N,) and places (N,) on the path."""
    plant, disco = plant_at(*start), planner_for(task)
    found = np.array(
        [
            (plant.x_m, plant.y_m, plant.yaw_rad, plant.forward_m_s, disco._memory)
            for _ in drive(disco, plant, range(round(seconds * 10)))
        ]
    )
    return found[:, :3], found[:, 3], found[:, 4]


def distance_to(waypoints, poses):
    fine = np.linspace(0.0, len(waypoints.places_m) - 1, 4000)
    columns = [np.interp(fine, np.arange(len(waypoints.places_m)), c) for c in waypoints.places_m.T]
    return np.hypot(poses[:, :1] - columns[0], poses[:, 1:2] - columns[1]).min(axis=1)


@pytest.mark.long
def test_a_closed_path_that_crosses_itself_is_driven_round():
    task = path_along(EIGHT, speed_m_s=0.25)
    poses, speeds, places = follow(task, 45.0, (0.0, 0.0, 0.8))
    assert distance_to(EIGHT, poses)[20:].mean() < 0.03
    assert speeds[50:].mean() == pytest.approx(0.25, abs=0.03)
    moved = np.diff(places)
    assert np.sum(moved < -100) == 1
    assert np.all((moved > -10) | (moved < -100))


def test_an_open_path_is_driven_to_its_end_and_no_further():
    poses, speeds, places = follow(path_along(CORNER, speed_m_s=0.25), 20.0, (0.0, 0.0, 0.0))
    assert distance_to(CORNER, poses).max() < 0.12
    assert np.hypot(*(poses[-1, :2] - [1.0, 1.0])) < 0.1
    assert np.abs(speeds[-10:]).max() < 0.05
    assert places[-1] > 95


def test_a_start_beside_the_path_joins_it():
    poses, _, _ = follow(path_along(EIGHT, speed_m_s=0.25), 25.0, (0.5, 1.2, math.pi))
    assert distance_to(EIGHT, poses)[150:].mean() < 0.05


ROUND = Waypoints(np.column_stack([np.sin(ANGLE), 1.0 - np.cos(ANGLE)]))


@thinned("trap", ["spinning", "standing"], quick=1)
def test_the_planner_leaves_the_traps(trap):
    task = path_along(ROUND, speed_m_s=0.2)
    plant, disco = plant_at(0.0, 0.0, 0.0), planner_for(task)
    begin_with(disco, plant, (-SPIN, SPIN) if trap == "spinning" else (0.0, 0.0))
    poses = [(plant.x_m, plant.y_m, plant.yaw_rad) for _ in drive(disco, plant, range(1, 151))]
    assert distance_to(ROUND, np.array(poses))[80:].mean() < 0.05
    # 15 s at 0.2 m/s, less the way out of the trap.
    assert disco._memory * task.path.spacing_m > 2.2


def test_a_round_path_is_driven_forwards():
    # The nearer to the path with the tracked point before the axle, which asks for driving backwards.
    poses, speeds, places = follow(path_along(ROUND, speed_m_s=0.25), 20.0, (0.0, 0.0, 0.0))
    assert speeds.min() > -0.02
    assert places[-1] * 0.02 > 4.0
    assert distance_to(ROUND, poses)[20:].mean() < 0.03


@thinned("yaw_rad", [math.pi, -2.0], quick=1)
def test_a_robot_that_faces_the_wrong_way_turns_round(yaw_rad):
    poses, speeds, places = follow(path_along(ROUND, speed_m_s=0.25), 15.0, (0.0, 0.0, yaw_rad))
    assert speeds[60:].min() > -0.02
    assert places[-1] * 0.02 > 2.0
    assert distance_to(ROUND, poses)[60:].mean() < 0.03


BACK = Waypoints(np.array([[0.0, 0.0], [1.2, 0.0], [0.0, 0.0]]))


def test_a_path_that_turns_back_is_driven_forwards_both_ways():
    poses, speeds, _ = follow(path_along(BACK, speed_m_s=0.25), 20.0, (0.0, 0.0, 0.0))
    x, heading = poses[:, 0], np.cos(poses[:, 2])
    tip = int(np.argmax(x > 1.13))
    assert x.max() > 1.13
    assert speeds[:tip].min() > -0.02
    # Back past the middle, looking where it goes.
    back = tip + int(np.argmax(x[tip:] < 0.5))
    assert back > tip
    assert heading[back] < -0.9
    assert speeds[back] > 0.1


def test_sharp_turns_cut_a_path_into_pieces():
    task = PathTable(BACK.places_m)
    assert task.closed
    assert task.sharp_turns == (0, 60)
    assert task.piece(30.0) == (30.0, 0.0, 60.0)
    assert task.piece(60.0) == (60.0, 60.0, 120.0)
    # Where it is on the way back is not taken for where it was on the way there, nor the other way round.
    assert task.place(1.0, 0.01, 0.0, 49.0) == 50.0
    assert task.place(1.0, 0.01, 0.0, 71.0) == 70.0
    # At the end of a piece the next begins, even if the end is not quite reached; the last is followed by the first.
    assert task.place(1.16, 0.0, 0.0, 57.0) == 60.0
    assert task.place(0.03, 0.0, 0.0, 117.0) == 0.0
    assert PathTable(EIGHT.places_m).sharp_turns == PathTable(CORNER.places_m).sharp_turns == ()


@pytest.mark.parametrize("half", [0.0, 0.5])
def test_a_way_straight_back_has_a_direction_everywhere_and_reaches_its_turn(half):
    # Where the turn lies half a piece beyond an entry, the entries before and behind it fall on the same place.
    turn = np.array([(30.0 + half) * SPACING_M, 0.0])
    table = PathTable(np.array([[0.0, 0.0], turn, [0.0, 0.0]])).table
    np.testing.assert_allclose(np.hypot(*table[:, 2:4].T), 1.0)
    assert np.hypot(*(table[:, :2] - turn).T).min() < 0.01 * SPACING_M
    assert np.hypot(*np.diff(table[:, :2], axis=0).T).min() > 0.3 * SPACING_M


def test_a_piece_of_a_closed_path_goes_on_past_the_first_way_point():
    # A drop, whose point is at the third way-point.
    drop = PathTable(np.array([[0.0, 0.0], [0.3, 0.3], [1.5, 0.0], [0.3, -0.3], [0.0, 0.0]]))
    (point,) = drop.sharp_turns
    count = len(drop.table) - 1
    np.testing.assert_allclose(drop.table[point, :2], [1.5, 0.0], atol=0.02)
    assert drop.piece(0.0) == (count, point, point + count)
    assert drop.piece(point + 1.0) == (point + 1.0, point, point + count)
    assert drop.place(0.02, 0.02, 0.0, count - 1.0) == 1.0


def test_a_turn_is_sharp_by_its_angle_over_a_length():
    def bent(angle_rad):
        leg = 0.02 * np.arange(1, 31)[:, None]
        there = np.concatenate([[[0.0, 0.0]], leg * [1.0, 0.0]])
        return np.concatenate([there, there[-1] + leg * [math.cos(angle_rad), math.sin(angle_rad)]])

    assert sharp_turns(bent(math.radians(120.0)), False, 7) == []
    for degrees in (130.0, -150.0, 180.0):
        assert sharp_turns(bent(math.radians(degrees)), False, 7) == [30]
    # As sharp, but over half a metre.
    around = np.linspace(0.0, np.pi, 40)
    assert sharp_turns(0.25 * np.column_stack([np.sin(around), 1.0 - np.cos(around)]), False, 7) == []


def test_a_path_without_length_is_refused():
    with pytest.raises(ValueError, match="it must be longer than"):
        PathTable(np.array([[0.0, 0.0], [0.001, 0.0]]))


@pytest.mark.parametrize("broken", [{"x_m": math.nan}, {"y_m": -math.inf}, {"yaw_rad": math.nan}])
@pytest.mark.parametrize("waypoints", [EIGHT, BACK, CORNER])
def test_a_state_that_is_none_is_reported_and_forgotten(waypoints, broken):
    disco = planner_for(path_along(waypoints))
    good = PlannerState(0, 0.1, 0.0, 0.0, 0.0, 0.0)
    disco.plan(0, good)
    stopping = disco.plan(100_000_000, msgspec.structs.replace(good, t_ns=100_000_000, **broken))
    assert stopping.diagnostics.outcome is PlanOutcome.STOPPING
    assert np.isfinite(stopping.wheel_speeds).all()
    after = disco.plan(200_000_000, msgspec.structs.replace(good, t_ns=200_000_000))
    assert after.diagnostics.outcome is PlanOutcome.PLANNED
    assert after.diagnostics.valid_samples == 400


def test_rollouts_are_relative_to_a_point_nearby_and_see_what_they_can_reach():
    line = path_along(Waypoints(np.array([[0.0, 0.0], [1900.0, 0.0]])))
    prepared = line.prepare(0.0, 1600.3, 0.0, 0.0, None, 0.1, 50)
    x = prepared.terms.table[0::4]
    assert prepared.memory * line.path.spacing_m == pytest.approx(1600.3, abs=0.01)
    assert prepared.begin == 0.0
    here = x[-int(prepared.terms.first)]
    assert here + prepared.origin_m[0] == pytest.approx(1600.3, abs=0.011)
    assert abs(here) < 1.1
    # Half a metre a step, back and on, is what rollouts may gain at most.
    assert prepared.terms.first * line.path.spacing_m == pytest.approx(-25.0, abs=0.1)
    assert prepared.terms.last * line.path.spacing_m == pytest.approx(25.0, abs=0.1)
    # Near the end there is less to see.
    assert line.prepare(0.0, 1899.0, 0.0, 0.0, None, 0.1, 50).terms.last * line.path.spacing_m == pytest.approx(
        1.0, abs=0.1
    )


@pytest.mark.parametrize("length_m", [1000.0, 1000.3])
def test_rollouts_at_the_end_of_a_long_path_are_relative_to_a_point_nearby(length_m):
    path = path_along(Waypoints(np.array([[-length_m, 0.0], [0.0, 0.0]])))
    prepared = path.prepare(0.0, 0.0, 0.0, 0.0, None, 0.1, 50)
    assert prepared.memory == len(path.path.table) - 1
    assert np.hypot(*prepared.origin_m) < 1.0
    assert np.abs(prepared.terms.table).max() < 60.0


def test_a_closed_path_goes_on_past_its_first_way_point_however_short_it_is():
    ring = path_along(Waypoints(0.3 * ROUND.places_m))
    prepared = ring.prepare(0.0, 0.3, 0.3, 0.0, None, 0.1, 50)
    table, count = prepared.terms.table.reshape(-1, 4), len(ring.path.table) - 1
    at = -int(prepared.terms.first)
    np.testing.assert_allclose(
        table[at : at + 3 * count, :2],
        np.tile(ring.path.table[:-1, :2], (4, 1))[int(prepared.memory) :][: 3 * count] - prepared.origin_m,
        atol=1e-6,
    )
    np.testing.assert_allclose(np.diff(table[:, :2], axis=0), table[:-1, 2:], atol=1e-6)
