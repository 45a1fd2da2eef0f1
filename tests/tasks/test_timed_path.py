"""A path by time: being at each place when its time has come."""

import math

import numpy as np
import pytest

from disco_hw.tasks.line import Waypoints
from disco_hw.tasks.timed_path import TimedPathCost
from tests.tasks.drives import SPIN, begin_with, drive, planner_for, plant_at

ANGLE = np.linspace(0.0, 2.0 * np.pi, 100)
ROUND = Waypoints(np.column_stack([np.sin(ANGLE), 1.0 - np.cos(ANGLE)]), 5.0 + 4.0 * ANGLE)


def test_places_are_reached_at_their_times_after_waiting_for_the_first():
    task = TimedPathCost(ROUND)
    plant = plant_at(0.0, 0.0, 0.3)
    off = [
        task.instant_cost((step - 9_999) * 0.1, plant.x_m, plant.y_m, plant.forward_m_s)
        for step in drive(planner_for(task), plant, range(10_000, 10_350))
    ]
    assert np.mean(off[60:]) < 0.05
    assert np.max(off[100:]) < 0.12


@pytest.mark.parametrize("trap", ["standing", "spinning"])
def test_the_planner_leaves_the_traps(trap):
    task = TimedPathCost(Waypoints(ROUND.places_m, 4.0 * ANGLE))
    plant, disco = plant_at(0.0, 0.0, 0.0), planner_for(task)
    begin_with(disco, plant, (-SPIN, SPIN) if trap == "spinning" else (0.0, 0.0))
    off = [
        task.instant_cost((step + 1) * 0.1, plant.x_m, plant.y_m, plant.forward_m_s)
        for step in drive(disco, plant, range(1, 151))
    ]
    assert np.mean(off[-50:]) < 0.08


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi])
def test_it_is_followed_forwards(yaw_rad):
    task = TimedPathCost(Waypoints(ROUND.places_m, 4.0 * ANGLE))
    plant = plant_at(0.0, 0.0, yaw_rad)
    speeds, off = [], []
    for step in drive(planner_for(task), plant, range(200)):
        speeds.append(plant.forward_m_s)
        off.append(task.instant_cost((step + 1) * 0.1, plant.x_m, plant.y_m, plant.forward_m_s))
    assert min(speeds[60:]) > -0.02
    assert np.mean(off[100:]) < 0.08


def test_where_the_place_rests_it_has_no_direction():
    terms = TimedPathCost(ROUND).prepare(4.75, 0.0, 0.0, 0.0, None, 0.1, 4).terms
    np.testing.assert_allclose(terms.along_x, [0.0, 0.0, 1.0, 1.0], atol=0.05)
    np.testing.assert_allclose(np.hypot(terms.along_x, terms.along_y), [0.0, 0.0, 1.0, 1.0], atol=1e-6)


def test_instant_cost_is_the_distance_to_where_the_robot_should_be():
    task = TimedPathCost(ROUND)
    assert task.instant_cost(0.0, 0.0, 0.0, 1.0) == pytest.approx(0.0)
    assert task.instant_cost(5.0 + 4.0 * np.pi, 0.0, 0.0, 0.0) == pytest.approx(2.0, abs=1e-3)


def test_times_are_needed():
    with pytest.raises(ValueError, match="have no times"):
        TimedPathCost(Waypoints(np.zeros((2, 2))))
