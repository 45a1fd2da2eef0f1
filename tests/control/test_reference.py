"""The oracle itself, by hand-worked numbers."""

import math

import numpy as np
import pytest

from disco_hw.control import Circle, pendulum, reference
from disco_hw.control.tasks.path import Path
from disco_hw.control.tasks.timed_path import TimedPath
from disco_hw.model.reference import State
from disco_hw.waypoints import Waypoints

THETA = {"wheel_radius_m": 0.1, "axial_distance_m": 0.5, "x_icr_m": 0.0}


def test_commands_change_by_no_more_than_allowed_and_stay_within_the_largest():
    nominal, noise = np.zeros((3, 2)), np.array([[[5.0, -0.2], [5.0, 0.0], [-9.0, 0.0]]])
    got = reference.limited(nominal, noise, np.array([0.0, 0.0]), 1.5, 1.0)
    np.testing.assert_allclose(got[0], [[1.0, -0.2], [1.5, 0.0], [0.5, 0.0]])


def test_control_cost():
    nominal, noise = np.array([[1.0], [2.0]]), np.array([[[0.5], [-1.0]]])
    assert reference.control_cost(nominal, noise, 2.0, 3.0)[0] == pytest.approx(3.0 * (0.5 - 2.0) / 4.0)


def test_straight_ahead_past_a_circle():
    start, commands = State(1.0, 0.0, 0.0, 0.0, 0.0), np.full((1, 2, 2), 2.0)
    cost = reference.circle_cost(Circle(radius_m=1.0).paper(), 0.5)
    expected = math.hypot(0.1, 0.0) + math.hypot(0.2, 0.0)
    got = reference.point_costs(THETA, start, commands, np.zeros((1, 2)), 0.5, cost)
    assert got[0] == pytest.approx(expected)


def test_mean_and_worst_part():
    costs, weights = np.array([[1.0], [5.0], [3.0]]), np.array([0.5, 0.2, 0.3])
    assert reference.mean_risk(costs, weights)[0] == pytest.approx(2.4)
    assert reference.cvar_risk(costs, weights, 0.2)[0] == pytest.approx(5.0)
    assert reference.cvar_risk(costs, weights, 0.4)[0] == pytest.approx(4.0)


def test_weights_and_temperature():
    weights = reference.softmax_weights(np.array([0.0, math.log(3.0), math.nan]), 1.0)
    np.testing.assert_allclose(weights, [0.75, 0.25, 0.0])
    assert reference.effective_sample_size(weights) == pytest.approx(1.6)
    costs = np.random.default_rng(1).gamma(2.0, size=400)
    found = reference.softmax_weights(costs, reference.temperature_for(costs, 20.0))
    assert reference.effective_sample_size(found) == pytest.approx(20.0)


def test_following_a_path_costs_nothing_and_standing_costs_the_speed():
    line = Waypoints(np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([0.0, 10.0]))
    moving = 0.02 * np.arange(6)[:, None]
    still = np.zeros((6, 1))
    by_length = reference.path_cost(Path(line, 0.2), 0.0, 0.1)
    by_time = reference.timed_path_cost(TimedPath(line), 0.0, 0.1)
    for cost in (by_length, by_time):
        assert cost(moving, still, still, moving[1:])[0] == pytest.approx(0.0, abs=1e-9)
    assert by_length(still, still, still, still[1:])[0] == pytest.approx(5 * 0.2)
    assert by_time(still, still, still, still[1:])[0] == pytest.approx(0.02 * 15)


def test_a_pendulum_that_balances_costs_nothing():
    assert reference.pendulum_costs(1.0, 1.0, 0.0, 0.0, np.zeros((1, 10)))[0] == 0.0
    hanging = reference.pendulum_costs(1.0, 1.0, math.pi, 0.0, np.zeros((1, 10)))[0]
    assert hanging == pytest.approx(10 * 4 * pendulum.UPRIGHT_WEIGHT)
