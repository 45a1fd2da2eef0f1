"""The filter on a robot of other equations: how soon it knows a robot, that it follows a change, and that it rests."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from disco_hw.adaptation.geometry_filter import GeometryFilter
from tools.foreign_plant import NOMINAL, ForeignPlant, ForeignRobot, robots

MEAN = np.array(NOMINAL)
TURN, STRAIGHT, STAND = (2.6, 4.6), (3.6, 3.6), (0.0, 0.0)


def learner():
    return GeometryFilter(MEAN, np.diag((0.15 / np.sqrt(3.0) * MEAN) ** 2), 0.5 * MEAN, 1.6 * MEAN)


def drive(found, plant, command, seconds):
    """Drive on; the filter's mean every 20 ms."""
    means = []
    for _ in range(round(seconds / 0.02)):
        readings = plant.readings()
        found.add(readings.wheels, readings.poses)
        plant.advance(*command, 20)
        means.append(found.mean)
    return np.array(means)


def truth(robot):
    return np.array([robot.radius_m, robot.axle_m, robot.x_icr_m])


def changed(plant, **fields):
    """The same plant as another robot from now on."""
    other = ForeignPlant(replace(plant.robot, **fields), plant.pose, 1)
    plant.robot, plant._numbers = other.robot, other._numbers


def test_ten_seconds_of_turning_tell_the_geometry_and_how_well_it_is_known():
    inside = []
    for seed, robot in enumerate(robots(200, 10)):
        found = learner()
        drive(found, ForeignPlant(robot, (0.0, 0.0, 0.3), seed), TURN, 10.0)
        error = found.mean - truth(robot)
        assert np.abs(error / truth(robot)).max() < 0.03
        inside.append(np.abs(error) < 1.645 * np.sqrt(np.diag(found.covariance)))
    assert np.mean(inside) > 0.75


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_another_wheel_is_known_after_two_and_a_half_seconds(factor):
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    drive(found, plant, TURN, 15.0)
    changed(plant, radius_m=factor * NOMINAL[0])
    means = drive(found, plant, TURN, 2.5)
    assert abs(means[-1, 0] / NOMINAL[0] - factor) < 0.03
    assert found.changes == 1


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_another_axle_is_known_after_fifteen_seconds(factor):
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    drive(found, plant, TURN, 15.0)
    changed(plant, axle_m=factor * NOMINAL[1])
    drive(found, plant, TURN, 15.0)
    assert abs(found.mean[1] / NOMINAL[1] - factor) < 0.03


def test_wheels_without_poses_are_not_kept_and_the_filter_learns_afterwards():
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    for _ in range(500):
        found.add(plant.readings().wheels, ())
        plant.advance(*TURN, 20)
    assert len(found._wheels) < 100
    drive(found, plant, TURN, 10.0)
    assert found.poses > 100


def test_a_pose_stamped_in_the_future_does_not_hold_up_those_after_it():
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    drive(found, plant, TURN, 2.0)
    while not (readings := plant.readings()).poses:
        found.add(readings.wheels, ())
        plant.advance(*TURN, 20)
    wrong = msgspec.structs.replace(readings.poses[0], t_ns=readings.poses[0].t_ns + 3_600_000_000_000)
    found.add(readings.wheels, (wrong,))
    before = found.poses
    drive(found, plant, TURN, 4.0)
    assert found.poses > before + 50


def test_a_robot_that_stands_teaches_nothing():
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    drive(found, plant, TURN, 10.0)
    drive(found, plant, STAND, 2.0)
    before, covariance = found.mean, found.covariance
    drive(found, plant, STAND, 60.0)
    np.testing.assert_array_equal(found.mean, before)
    np.testing.assert_array_equal(found.covariance, covariance)


def test_ten_minutes_of_straight_lines_and_standing_leave_axle_and_x_icr_alone():
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 3)
    drive(found, plant, TURN, 20.0)
    before = found.mean
    for _ in range(10):
        drive(found, plant, STRAIGHT, 40.0)
        drive(found, plant, STAND, 20.0)
    assert np.abs(found.mean / before - 1.0).max() < 0.015


def test_a_robot_that_was_carried_is_found_again():
    found, plant = learner(), ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 1)
    drive(found, plant, TURN, 10.0)
    drive(found, plant, STAND, 2.0)
    plant.state[:3] = 2.0, -1.0, -2.0
    drive(found, plant, TURN, 10.0)
    assert found.carried == 1
    assert np.abs(found.mean / MEAN - 1.0).max() < 0.03


def test_the_same_samples_give_the_same_numbers():
    two = []
    for _ in range(2):
        found = learner()
        drive(found, ForeignPlant(ForeignRobot(*NOMINAL), (0.0, 0.0, 0.3), 4), TURN, 3.0)
        two.append((found.mean.tobytes(), found.covariance.tobytes()))
    assert two[0] == two[1]


def test_what_is_learnt_stays_within_the_prior():
    narrow = GeometryFilter(MEAN, np.diag((0.1 * MEAN) ** 2), 0.97 * MEAN, 1.03 * MEAN)
    means = drive(narrow, ForeignPlant(ForeignRobot(*(1.15 * MEAN)), (0.0, 0.0, 0.3), 1), TURN, 5.0)
    assert (means >= 0.97 * MEAN).all()
    assert (means <= 1.03 * MEAN).all()
