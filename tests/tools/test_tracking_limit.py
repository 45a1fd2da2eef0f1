"""The least distance to a line: the closed form where it holds, and what follows from it."""

import math
from dataclasses import replace

import pytest

from sim.plant_parameters import PlantParameters
from tools.tracking_limit import SPEED_M_S, least_rms_m

STRAIGHT_M = 1e4


def test_with_short_sideways_slip_on_a_straight_line_it_is_the_closed_form():
    plant = replace(PlantParameters(), slip_std_y_m_s=0.04, slip_std_yaw_rad_s=1e-5, slip_correlation_s=0.003)
    density = 2.0 * plant.slip_std_y_m_s**2 * plant.slip_correlation_s
    expected_m = math.sqrt(2.0 * density * plant.x_icr_m / SPEED_M_S)
    assert least_rms_m(plant, STRAIGHT_M)[0] == pytest.approx(expected_m, rel=0.03)


def test_noisy_poses_cost_more_and_speed_helps():
    plant = PlantParameters()
    known_m, estimated_m = least_rms_m(plant)
    assert known_m < estimated_m < least_rms_m(replace(plant, pose_position_std_m=0.01))[1]
    assert least_rms_m(plant, speed_m_s=0.4)[1] < estimated_m
