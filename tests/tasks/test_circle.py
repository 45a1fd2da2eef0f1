"""The circle: its cost, and the two traps of the paper's cost alone."""

import math

import numpy as np
import pytest

from disco_hw.config import Robot
from disco_hw.control.plan import DiscoSettings
from disco_hw.model import plain as physics
from disco_hw.tasks.circle import RADIUS_M, CircleCost, CircleTask
from tests.control import oracle
from tests.tasks.costs import circle_cost, instant_cost
from tests.tasks.drives import MEAN, begin_with, drive, planner_for, plant_at

T, STEP_S = 50, 0.1
GEOMETRY = {
    "name": "r",
    "wheel_radius_m": 0.06,
    "axial_distance_m": 0.31,
    "ticks_per_rev": 2048,
    "max_wheel_speed_rad_s": 8.0,
}


def sequence_cost(circle, start, left, right):
    """Cost of constant wheel speeds over the horizon, from a state."""
    commands = np.broadcast_to([left, right], (1, T, 2))
    past = np.zeros((1, 2))
    return oracle.point_costs(MEAN, start, commands, past, STEP_S, circle_cost(circle, STEP_S))[0]


def on_circle():
    """State and wheel speeds of driving round the circle with s = 0.2 for ever."""
    omega = 0.2 / math.sqrt(0.75**2 - 0.238**2)
    inward = math.atan(0.238 * omega / 0.2)
    state = physics.RobotState(0.75, 0.0, math.pi / 2 + inward, 0.0, 0.0)
    sum_, difference = 0.2 / 0.061, omega * 0.415 / 0.061 / 2.0
    return state, sum_ - difference, sum_ + difference


def spinning():
    """State and wheel speeds of turning on the spot, about the offset centre of rotation, near the edge."""
    omega = 1.6
    difference = omega * 0.415 / 0.061 / 2.0
    return physics.RobotState(0.75, 0.238, math.pi, 0.0, 0.0), -difference, difference


def test_the_papers_cost_of_standing_still_on_the_circle_is_s0():
    paper = CircleCost().paper()
    assert instant_cost(paper, 0.75, 0.0, 0.0) == pytest.approx(0.2)
    assert sequence_cost(paper, physics.RobotState(0.75, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0) == pytest.approx(0.2 * T)


def test_driving_round_costs_nothing_and_pays_for_no_progress():
    for circle in (CircleCost(), CircleCost().paper()):
        assert sequence_cost(circle, *on_circle()) == pytest.approx(0.0, abs=1e-3)


def test_progress_takes_the_reward_from_standing_and_from_spinning():
    standstill = (physics.RobotState(0.75, 0.0, math.pi / 2, 0.0, 0.0), 0.0, 0.0)
    for trap in (standstill, spinning()):
        assert sequence_cost(CircleCost(), *trap) > sequence_cost(CircleCost().paper(), *trap) + 0.05 * T
    assert sequence_cost(CircleCost(), *spinning()) > 0.3 * T


@pytest.mark.parametrize("start", ["standing", "spinning", "centre"])
def test_the_planner_leaves_the_traps(start):
    state, left, right = spinning()
    places = {
        "standing": (0.75, 0.0, math.pi / 2),
        "spinning": (state.x, state.y, state.yaw),
        "centre": (0.0, 0.0, 0.0),
    }
    plant, disco = plant_at(*places[start]), planner_for(CircleCost())
    if start == "spinning":
        begin_with(disco, plant, (left, right))
    angles, costs = [math.atan2(plant.y_m, plant.x_m)], []
    for _ in drive(disco, plant, range(1, 201)):
        angles.append(math.atan2(plant.y_m, plant.x_m))
        costs.append(instant_cost(CircleCost(), plant.x_m, plant.y_m, plant.forward_m_s))
    assert np.mean(costs[-50:]) < 0.04
    travelled = np.unwrap(angles)
    assert travelled[-1] - travelled[0] > math.pi


def test_the_horizon_of_half_the_length_no_longer_ends_in_a_trap():
    plant = plant_at(0.75, 0.0, math.pi / 2)
    costs = [
        instant_cost(CircleCost(), plant.x_m, plant.y_m, plant.forward_m_s)
        for _ in drive(planner_for(CircleCost(), DiscoSettings(step_s=0.05)), plant, range(200))
    ]
    assert np.mean(costs[100:]) < 0.12


@pytest.mark.parametrize("x_icr_m", [0.238, -0.238])
def test_a_circle_that_the_tracked_point_cannot_go_round_is_refused_with_the_least_radius(x_icr_m):
    robot = Robot(**GEOMETRY, x_icr_m=x_icr_m)
    fault = CircleTask(radius_m=0.25).beyond_robot(robot)
    assert (fault.field, fault.hint) == ("radius_m", "write at least 0.251")
    assert "0.25 m is too small" in fault.fault
    assert CircleTask(radius_m=0.251).beyond_robot(robot) is None
    assert CircleTask().editable(robot)["radius_m"][:2] == (0.251, RADIUS_M[1])
    assert CircleTask().editing_note(robot).startswith("Radius 0.251 to 50 m;")
    # A robot that turns about its tracked point goes round any circle.
    assert CircleTask(radius_m=0.1, speed_m_s=0.1).beyond_robot(Robot(**GEOMETRY)) is None


def test_a_larger_radius_is_offered_only_where_it_helps():
    robot = Robot(**GEOMETRY)
    assert CircleTask(speed_m_s=0.45).beyond_robot(robot).hint == "write at most 0.397 m/s, or a larger radius"
    assert CircleTask(speed_m_s=0.6).beyond_robot(robot).hint == "write at most 0.397 m/s"


def test_the_section_gives_cost_and_outline():
    task = CircleTask(center_x_m=1.0, radius_m=2.0, speed_m_s=0.3)
    circle = task.planned("default")
    assert (circle.center_x_m, circle.radius_m, circle.speed_m_s) == (1.0, 2.0, 0.3)
    assert circle.prepare(0.0, 5.0, 0.0, 0.0, None, 0.1, 50).origin_m == (1.0, 0.0)
    assert circle.progress_weight > 0.0
    assert CircleTask().planned("paper") == CircleCost().paper()
    picture = task.course().outline_m()
    np.testing.assert_allclose(np.hypot(picture[:, 0] - 1.0, picture[:, 1]), 2.0)
