"""A path by arc length: followed at its speed, through crossings, to its end; standing still is not optimal."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from disco_hw.control import Disco, DiscoSettings, PlannerState, WheelLimits
from disco_hw.control.experiments.plant import Plant
from disco_hw.control.tasks.path import Path
from disco_hw.model import load_model
from disco_hw.waypoints import Waypoints

MODEL = load_model(FilePath(__file__).parents[3] / "disco_hw/robots/wombot_model.toml")
MEAN = {"wheel_radius_m": 0.061, "axial_distance_m": 0.415, "x_icr_m": 0.238}
ANGLE = np.linspace(0.0, 2.0 * np.pi, 200)
EIGHT = Waypoints(np.column_stack([1.5 * np.sin(ANGLE), 0.75 * np.sin(2.0 * ANGLE)]))
CORNER = Waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))


def follow(task, seconds, start):
    """Drive along; returns poses (N, 3), speeds (N,) and places (N,) on the path."""
    plant = Plant(MEAN, start, 0.1, 0.0, 1)
    disco = Disco(MODEL, task, DiscoSettings(), WheelLimits(8.0, 20.0), 2)
    found = []
    for step in range(round(seconds * 10)):
        now_ns = step * 100_000_000
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels)
        plant.advance(*disco.plan(now_ns, state).at(now_ns), 0.1)
        found.append((plant.x_m, plant.y_m, plant.yaw_rad, plant.forward_m_s, disco._memory))
    found = np.array(found)
    return found[:, :3], found[:, 3], found[:, 4]


def distance_to(waypoints, poses):
    fine = np.linspace(0.0, len(waypoints.places_m) - 1, 4000)
    columns = [np.interp(fine, np.arange(len(waypoints.places_m)), c) for c in waypoints.places_m.T]
    return np.hypot(poses[:, :1] - columns[0], poses[:, 1:2] - columns[1]).min(axis=1)


@pytest.mark.long
def test_a_closed_path_that_crosses_itself_is_driven_round():
    task = Path(EIGHT, speed_m_s=0.25)
    poses, speeds, places = follow(task, 45.0, (0.0, 0.0, 0.8))
    assert distance_to(EIGHT, poses)[20:].mean() < 0.03
    assert speeds[50:].mean() == pytest.approx(0.25, abs=0.03)
    moved = np.diff(places)
    assert np.sum(moved < -100) == 1
    assert np.all((moved > -10) | (moved < -100))


def test_an_open_path_is_driven_to_its_end_and_no_further():
    poses, speeds, places = follow(Path(CORNER, speed_m_s=0.25), 20.0, (0.0, 0.0, 0.0))
    assert distance_to(CORNER, poses).max() < 0.12
    assert np.hypot(*(poses[-1, :2] - [1.0, 1.0])) < 0.1
    assert np.abs(speeds[-10:]).max() < 0.05
    assert places[-1] > 95


def test_a_start_beside_the_path_joins_it():
    poses, _, _ = follow(Path(EIGHT, speed_m_s=0.25), 25.0, (0.5, 1.2, math.pi))
    assert distance_to(EIGHT, poses)[150:].mean() < 0.05


def test_instant_cost_and_picture():
    task = Path(CORNER, speed_m_s=0.2)
    assert task.instant_cost(0.0, 0.5, 0.3, 0.2) == pytest.approx(0.3)
    assert task.instant_cost(0.0, 0.5, 0.0, 0.0) == pytest.approx(0.2)
    np.testing.assert_array_equal(task.picture(), CORNER.places_m)


def test_a_path_without_length_is_refused():
    with pytest.raises(ValueError, match="it must be longer than"):
        Path(Waypoints(np.array([[0.0, 0.0], [0.001, 0.0]])))
