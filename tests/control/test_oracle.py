"""The oracle itself, by hand-worked numbers."""

import math

import numpy as np
import pytest

from disco_hw.control import pendulum
from disco_hw.model.plain import RobotState
from disco_hw.tasks.circle import CircleCost
from disco_hw.tasks.line import Waypoints
from disco_hw.tasks.timed_path import TimedPathCost
from tests.control import oracle
from tests.tasks.costs import circle_cost, path_along, path_cost, timed_path_cost

LINE = Waypoints(np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([0.0, 10.0]))
BY_LENGTH, BY_TIME = path_cost(path_along(LINE, 0.2), 0.0, 0.1), timed_path_cost(TimedPathCost(LINE), 0.0, 0.1)
MOVING, STILL = 0.02 * np.arange(6)[:, None], np.zeros((6, 1))
"""Five steps of 0.1 s along the line at 0.2 m/s, and of a robot at rest."""
THETA = {"wheel_radius_m": 0.1, "axial_distance_m": 0.5, "x_icr_m": 0.0}


def test_commands_change_by_no_more_than_allowed_and_stay_within_the_largest():
    nominal, noise = np.zeros((3, 2)), np.array([[[5.0, -0.2], [5.0, 0.0], [-9.0, 0.0]]])
    got = oracle.limited(nominal, noise, np.array([0.0, 0.0]), 1.5, 1.0)
    np.testing.assert_allclose(got[0], [[1.0, -0.2], [1.5, 0.0], [0.5, 0.0]])


def test_control_cost():
    nominal, noise = np.array([[1.0], [2.0]]), np.array([[[0.5], [-1.0]]])
    assert oracle.control_cost(nominal, noise, 2.0, 3.0)[0] == pytest.approx(3.0 * (0.5 - 2.0) / 4.0)


def test_straight_ahead_past_a_circle():
    start, commands = RobotState(1.0, 0.0, 0.0, 0.0, 0.0), np.full((1, 2, 2), 2.0)
    cost = circle_cost(CircleCost(radius_m=1.0).paper(), 0.5)
    expected = math.hypot(0.1, 0.0) + math.hypot(0.2, 0.0)
    got = oracle.point_costs(THETA, start, commands, np.zeros((1, 2)), 0.5, cost)
    assert got[0] == pytest.approx(expected)


def test_mean_and_worst_part():
    costs, weights = np.array([[1.0], [5.0], [3.0]]), np.array([0.5, 0.2, 0.3])
    assert oracle.mean_risk(costs, weights)[0] == pytest.approx(2.4)
    assert oracle.cvar_risk(costs, weights, 0.2)[0] == pytest.approx(5.0)
    assert oracle.cvar_risk(costs, weights, 0.4)[0] == pytest.approx(4.0)


def test_weights_and_temperature():
    weights = oracle.softmax_weights(np.array([0.0, math.log(3.0), math.nan]), 1.0)
    np.testing.assert_allclose(weights, [0.75, 0.25, 0.0])
    assert oracle.effective_sample_size(weights) == pytest.approx(1.6)
    costs = np.random.default_rng(1).gamma(2.0, size=400)
    found = oracle.softmax_weights(costs, oracle.temperature_for(costs, 20.0))
    assert oracle.effective_sample_size(found) == pytest.approx(20.0)


def test_following_a_path_costs_nothing_and_standing_costs_the_speed():
    for cost in (BY_LENGTH, BY_TIME):
        assert cost(MOVING, STILL, STILL, np.full((5, 1), 0.2))[0] == pytest.approx(0.0, abs=1e-9)
    # As dear as being STANDING_M beside it.
    assert BY_LENGTH(STILL, STILL, STILL, STILL[1:])[0] == pytest.approx(5 * 0.2)
    assert BY_TIME(STILL, STILL, STILL, STILL[1:])[0] == pytest.approx(0.02 * 15)


def test_going_backwards_costs_the_whole_speed_and_facing():
    back, across = np.full((6, 1), math.pi), np.full((6, 1), 0.5 * math.pi)
    assert BY_LENGTH(MOVING, STILL, back, np.full((5, 1), -0.2))[0] == pytest.approx(5 * (0.2 + 0.6))
    # Sideways, as in sliding round a corner, is progress as long as the robot does not drive backwards.
    assert BY_LENGTH(MOVING, STILL, across, STILL[1:])[0] == pytest.approx(0.0, abs=1e-9)
    assert BY_LENGTH(MOVING, STILL, across, np.full((5, 1), -0.1))[0] == pytest.approx(5 * 0.1)
    assert BY_TIME(MOVING, STILL, back, np.full((5, 1), -0.2))[0] == pytest.approx(5 * 0.6)


def test_the_last_distance_of_a_path_counts_for_a_second_more():
    beside = np.full((6, 1), 0.3)
    cost = path_cost(path_along(LINE, 0.2), 50.0, 0.1)
    expected = 5 * math.hypot(0.3, 0.2) + 10 * 0.3
    assert cost(np.ones((6, 1)), beside, STILL, STILL[1:])[0] == pytest.approx(expected)


def test_a_place_does_not_leave_its_piece():
    there_and_back = path_along(Waypoints(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])), 0.2)
    past = 0.98 + MOVING
    cost = path_cost(there_and_back, 49.0, 0.1)
    # It is wanted to stop at the piece's end, so going on costs more and more: distance and, as a speed, all of it.
    got = cost(past, STILL, STILL, np.full((5, 1), 0.2))[0]
    beyond = 0.02 * np.arange(5)
    wanted = np.array([0.02, *np.zeros(4)])
    along = np.array([0.2, *np.minimum(beyond[1:] / 0.1, 0.2)])
    assert got == pytest.approx(np.hypot(beyond, wanted - along).sum() + 10 * beyond[-1])


def test_a_pendulum_that_balances_costs_nothing():
    assert oracle.pendulum_costs(1.0, 1.0, 0.0, 0.0, np.zeros((1, 10)))[0] == 0.0
    hanging = oracle.pendulum_costs(1.0, 1.0, math.pi, 0.0, np.zeros((1, 10)))[0]
    assert hanging == pytest.approx(10 * 4 * pendulum.UPRIGHT_WEIGHT)
