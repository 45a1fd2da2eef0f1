"""The table of who follows a line best, and its robots."""

from __future__ import annotations

import math

import numpy as np
import pytest

from disco_hw.control.baselines import Kanayama
from tools import bench_tracking
from tools.foreign_plant import ForeignPlant, robots, turned_robot
from tools.mujoco_plant import BEHIND_M, mujoco_plant, mujoco_robots
from tools.tracking import Drive, classical, drive, tracks


def test_a_robot_in_mujoco_turns_about_the_point_that_it_is_said_to():
    pytest.importorskip("mujoco")
    (robot,) = mujoco_robots(1000, 1, 0.0)
    plant = mujoco_plant(robot, (1.0, 2.0, 0.5), 1)
    assert plant.pose == (1.0, 2.0, 0.5)
    poses, angles, forward = [], [], []
    for _ in range(250):
        plant.advance(0.0, 3.0, 20)
        poses.append(plant.pose)
        forward.append(plant.forward_m_s)
        angles += [(one.left_angle_rad, one.right_angle_rad) for one in plant.readings().wheels]
    settled = np.array(poses[150:])
    moved, yaw = np.diff(settled[:, :2], axis=0), settled[1:, 2]
    turned = np.diff(settled[:, 2])
    aside = moved[:, 1] * np.cos(yaw) - moved[:, 0] * np.sin(yaw)
    assert aside.sum() / turned.sum() == pytest.approx(-BEHIND_M, rel=0.1)
    left, right = np.array(angles[-1]) - np.array(angles[150])
    assert robot.radius_m * (right - left) / turned.sum() == pytest.approx(robot.axle_m, rel=0.1)
    assert np.mean(forward[150:]) == pytest.approx(robot.radius_m * 0.5 * (left + right) / 2.0, rel=0.1)


def test_what_is_believed_of_the_robots_in_mujoco_is_off():
    found = np.array([one.believed for one in mujoco_robots(1000, 30)])
    truth = np.array([(one.radius_m, one.axle_m, one.x_icr_m) for one in mujoco_robots(1000, 1)])
    assert (np.abs(found / truth - 1.0) < 0.15).all()
    assert (np.abs(found / truth - 1.0).max(axis=0) > 0.1).all()


def test_a_follower_drives_the_robot_in_mujoco_round_its_circle():
    pytest.importorskip("mujoco")
    (robot,) = mujoco_robots(1000, 1, 0.0)
    found = drive(classical(Kanayama()), robot, tracks()["circle"], duration_s=9.0, plant_of=mujoco_plant)
    assert found.after(4.0).rms_mm < 20.0
    assert found.after(4.0).speed_m_s > 0.15


def test_a_robot_whose_back_is_its_front_is_the_same_machine():
    """It turns as the robot does that gets the same motion by its own front, and its sensors agree with its pose."""
    (robot,) = robots(1000, 1, grip_std=0.0, pose_std_m=0.0, yaw_std_rad=0.0, pose_delay_s=0.0)
    plant = ForeignPlant(robot, (1.0, 2.0, 0.5), 1)
    turned = ForeignPlant(turned_robot(robot), (1.0, 2.0, 0.5 + math.pi), 1)
    for _ in range(100):
        plant.advance(-3.0, -2.0, 20)
        turned.advance(2.0, 3.0, 20)
        expected, found = plant.readings(), turned.readings()
    assert turned.forward_m_s == pytest.approx(-plant.forward_m_s)
    assert turned.forward_m_s > 0.1
    assert turned.pose[:2] == pytest.approx(plant.pose[:2])
    assert math.remainder(turned.pose[2] - plant.pose[2] - math.pi, math.tau) == pytest.approx(0.0, abs=1e-9)
    assert (found.wheels[0].left_angle_rad, found.wheels[0].right_speed_rad_s) == pytest.approx(
        (-expected.wheels[0].right_angle_rad, -expected.wheels[0].left_speed_rad_s)
    )
    assert math.remainder(found.poses[0].yaw_rad - turned.pose[2], math.tau) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("more", "first"), [((), bench_tracking.FIRST), (("--first", "5000"), 5000)])
def test_the_robots_are_those_that_are_asked_for(monkeypatch, capsys, more, first):
    driven = []

    def driving(_contender, robot, _track, **_options):
        driven.append(robot)
        return Drive(np.array([6.0, 7.0]), np.zeros((2, 3)), np.zeros(2), np.zeros((2, 2)), np.zeros(2))

    monkeypatch.setattr(bench_tracking, "drive", driving)
    bench_tracking.main(["kanayama", "circle", "3", *more])
    assert driven == robots(first, 3)
    assert capsys.readouterr().out.startswith("tracking.kanayama.circle")
