"""A path by time: being at each place when its time has come."""

import math

import numpy as np

from disco_hw.control import DiscoSettings
from disco_hw.tasks.line import Waypoints
from disco_hw.tasks.line.course import END_M
from disco_hw.tasks.timed_path import TimedPathCost
from tests.tables import thinned
from tests.tasks.costs import instant_cost
from tests.tasks.drives import SPIN, begin_with, drive, planner_for, plant_at

ANGLE = np.linspace(0.0, 2.0 * np.pi, 100)
ROUND = Waypoints(np.column_stack([np.sin(ANGLE), 1.0 - np.cos(ANGLE)]), 5.0 + 4.0 * ANGLE)


FROM_START = Waypoints(ROUND.places_m, 4.0 * ANGLE)


def followed(task, plant, planner, steps, begin=0):
    """Drive for these steps; distance (m) to where the robot should be after each, by a time that begins with one."""
    return [
        instant_cost(task, plant.x_m, plant.y_m, plant.forward_m_s, (step + 1 - begin) * 0.1)
        for step in drive(planner, plant, steps)
    ]


def test_places_are_reached_at_their_times_after_waiting_for_the_first():
    task = TimedPathCost(ROUND)
    off = followed(task, plant_at(0.0, 0.0, 0.3), planner_for(task), range(10_000, 10_350), 10_000)
    assert np.mean(off[60:]) < 0.05
    assert np.max(off[100:]) < 0.12


def test_a_refined_plan_is_nearer_to_the_place_than_a_sampled_one_and_stops_at_the_last():
    task, off = TimedPathCost(FROM_START), {}
    for refine in (False, True):
        planner = planner_for(task, DiscoSettings.for_speed(0.25, 10.0, refine))
        off[refine] = followed(task, plant_at(0.0, 0.0, 0.0), planner, range(300))
    # The circle takes 25 s; the first seconds are those of a robot that comes from rest.
    assert np.mean(off[True][60:250]) < 0.005
    assert np.mean(off[True][60:250]) < 0.2 * np.mean(off[False][60:250])
    assert off[True][-1] < END_M


def test_the_heading_is_that_of_a_robot_that_stays_with_the_place():
    """On a circle it is turned inwards by asin(x_icr / radius); before the place moves it waits for that."""
    radius_m, x_icr_m, ahead = 1.0, 0.2, 100
    rests, goes_on = (
        TimedPathCost(ROUND).prepare(time_s, 0.0, 0.0, 0.0, None, 0.1, ahead).terms.headings(x_icr_m)
        for time_s in (0.0, 5.0)
    )
    turned = math.asin(x_icr_m / radius_m)
    # Of the last pieces the heading ends along the way, which is forgotten x_icr before.
    settled = np.arange(60)
    np.testing.assert_allclose(goes_on[:60], turned + settled * 0.1 / 4.0, atol=0.02)
    np.testing.assert_allclose(rests[:50], goes_on[0], atol=0.02)
    # Ground that carries it by a tenth of its way, across, is made up for by as large an angle.
    ahead = Waypoints(np.array([[0.0, 0.0], [9.0, 0.0]]), np.array([0.0, 90.0]))
    terms = TimedPathCost(ahead).prepare(5.0, 0.0, 0.0, 0.0, None, 0.1, 40).terms
    np.testing.assert_allclose(terms.headings(x_icr_m, 0.001j), -math.atan(0.1), atol=1e-3)
    np.testing.assert_allclose(terms.headings(x_icr_m), 0.0, atol=1e-3)
    still = Waypoints(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([50.0, 60.0]))
    assert TimedPathCost(still).prepare(0.0, 0.0, 0.0, 0.0, None, 0.1, 40).terms.headings(x_icr_m) is None


@thinned("trap", ["spinning", "standing"], quick=1)
def test_the_planner_leaves_the_traps(trap):
    task = TimedPathCost(FROM_START)
    plant, disco = plant_at(0.0, 0.0, 0.0), planner_for(task)
    begin_with(disco, plant, (-SPIN, SPIN) if trap == "spinning" else (0.0, 0.0))
    assert np.mean(followed(task, plant, disco, range(1, 151))[-50:]) < 0.08


@thinned("yaw_rad", [math.pi, 0.0], quick=1)
def test_it_is_followed_forwards(yaw_rad):
    task, plant = TimedPathCost(FROM_START), plant_at(0.0, 0.0, yaw_rad)
    speeds, off = [], []
    for step in drive(planner_for(task), plant, range(200)):
        speeds.append(plant.forward_m_s)
        off.append(instant_cost(task, plant.x_m, plant.y_m, plant.forward_m_s, (step + 1) * 0.1))
    assert min(speeds[60:]) > -0.02
    assert np.mean(off[100:]) < 0.08


def test_where_the_place_rests_it_has_no_direction():
    terms = TimedPathCost(ROUND).prepare(4.75, 0.0, 0.0, 0.0, None, 0.1, 4).terms
    np.testing.assert_allclose(terms.along_x, [0.0, 0.0, 1.0, 1.0], atol=0.05)
    np.testing.assert_allclose(np.hypot(terms.along_x, terms.along_y), [0.0, 0.0, 1.0, 1.0], atol=1e-6)
