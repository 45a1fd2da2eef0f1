"""A path by time: being at each place when its time has come."""

import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from disco_hw.control import CommandLimits, Disco, DiscoSettings, PlannerState
from disco_hw.experiments.circle import KinematicPlant
from disco_hw.model import load_model
from disco_hw.tasks.line import Waypoints
from disco_hw.tasks.timed_path import TimedPathCost

MODEL = load_model(FilePath(__file__).parents[2] / "disco_hw/robots/wombot_model.toml")
MEAN = {"wheel_radius_m": 0.061, "axial_distance_m": 0.415, "x_icr_m": 0.238}
ANGLE = np.linspace(0.0, 2.0 * np.pi, 100)
ROUND = Waypoints(np.column_stack([np.sin(ANGLE), 1.0 - np.cos(ANGLE)]), 5.0 + 4.0 * ANGLE)


def test_places_are_reached_at_their_times_after_waiting_for_the_first():
    task = TimedPathCost(ROUND)
    plant = KinematicPlant(MEAN, (0.0, 0.0, 0.3), 0.1, 0.0, 1)
    disco = Disco(MODEL, task, DiscoSettings(), CommandLimits(8.0, 20.0), 2)
    off = []
    for step in range(350):
        now_ns = 10**12 + step * 100_000_000
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels)
        plant.advance(*disco.plan(now_ns, state).at(now_ns), 0.1)
        off.append(task.instant_cost((step + 1) * 0.1, plant.x_m, plant.y_m, plant.forward_m_s))
    assert np.mean(off[60:]) < 0.05
    assert np.max(off[100:]) < 0.12


# Wheel speeds (rad/s) of spinning at 1.6 rad/s about the point of rotation.
SPIN = 1.6 * MEAN["axial_distance_m"] / MEAN["wheel_radius_m"] / 2.0


@pytest.mark.parametrize("trap", ["standing", "spinning"])
def test_the_planner_leaves_the_traps(trap):
    task = TimedPathCost(Waypoints(ROUND.places_m, 4.0 * ANGLE))
    plant = KinematicPlant(MEAN, (0.0, 0.0, 0.0), 0.1, 0.0, 1)
    disco = Disco(MODEL, task, DiscoSettings(), CommandLimits(8.0, 20.0), 2)
    if trap == "spinning":
        plant.wheels = (-SPIN, SPIN)
    # The trap is the plan that it starts from.
    disco.plan(0, PlannerState(0, 0.0, 0.0, 0.0, *plant.wheels))
    disco.optimiser.set_nominal(np.broadcast_to(plant.wheels, (disco.settings.sampler.horizon, 2)))
    off = []
    for step in range(1, 151):
        now_ns = step * 100_000_000
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels)
        plant.advance(*disco.plan(now_ns, state).at(now_ns), 0.1)
        off.append(task.instant_cost((step + 1) * 0.1, plant.x_m, plant.y_m, plant.forward_m_s))
    assert np.mean(off[-50:]) < 0.08


@pytest.mark.parametrize("yaw_rad", [0.0, math.pi])
def test_it_is_followed_forwards(yaw_rad):
    task = TimedPathCost(Waypoints(ROUND.places_m, 4.0 * ANGLE))
    plant = KinematicPlant(MEAN, (0.0, 0.0, yaw_rad), 0.1, 0.0, 1)
    disco = Disco(MODEL, task, DiscoSettings(), CommandLimits(8.0, 20.0), 2)
    speeds, off = [], []
    for step in range(200):
        now_ns = step * 100_000_000
        state = PlannerState(now_ns, plant.x_m, plant.y_m, plant.yaw_rad, *plant.wheels)
        plant.advance(*disco.plan(now_ns, state).at(now_ns), 0.1)
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
