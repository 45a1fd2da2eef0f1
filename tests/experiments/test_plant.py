"""The plant of the circle experiment against closed forms."""

import math

import numpy as np
import pytest

from disco_hw.experiments.circle import SUBSTEP_S, KinematicPlant

THETA = {"wheel_radius_m": 0.06, "axial_distance_m": 0.4, "x_icr_m": 0.2}


def test_equal_wheels_drive_straight_along_the_yaw():
    plant = KinematicPlant(THETA, (1.0, 2.0, math.pi / 6), 0.0, 0.0, 1)
    plant.advance(5.0, 5.0, 2.0)
    assert (plant.x_m, plant.y_m) == pytest.approx((1.0 + 0.6 * math.cos(math.pi / 6), 2.0 + 0.6 * 0.5))
    assert (plant.yaw_rad, plant.forward_m_s, *plant.wheels) == pytest.approx((math.pi / 6, 0.3, 5.0, 5.0))


def test_a_turn_on_the_spot_leaves_the_point_of_rotation_where_it_is():
    plant = KinematicPlant(THETA, (0.0, 0.0, 0.0), 0.0, 0.0, 1)
    for _ in range(30):
        plant.advance(-3.0, 3.0, 0.1)
    assert plant.yaw_rad == pytest.approx(3.0 * 0.06 * 6.0 / 0.4)
    axle = plant.x_m + 0.2 * math.cos(plant.yaw_rad), plant.y_m + 0.2 * math.sin(plant.yaw_rad)
    assert axle == pytest.approx((0.2, 0.0), abs=1e-4)


def test_wheels_lag_by_the_time_constant():
    plant = KinematicPlant(THETA, (0.0, 0.0, 0.0), 0.1, 0.0, 1)
    plant.advance(4.0, -2.0, 0.1)
    part = 1.0 - math.exp(-1.0)
    assert plant.wheels == pytest.approx((4.0 * part, -2.0 * part))


def test_noise_is_relative_white_and_repeats_with_its_seed():
    def speeds(seed):
        plant = KinematicPlant(THETA, (0.0, 0.0, 0.0), 0.0, 0.05, seed)
        found = []
        for _ in range(2000):
            plant.advance(5.0, 5.0, SUBSTEP_S)
            found.append(plant.forward_m_s)
        return np.array(found)

    found = speeds(1)
    np.testing.assert_array_equal(found, speeds(1))
    assert not np.array_equal(found, speeds(2))
    # The mean of two wheels of 5 % each.
    assert found.std() == pytest.approx(0.3 * 0.05 / math.sqrt(2.0), rel=0.1)
    assert abs(np.corrcoef(found[1:], found[:-1])[0, 1]) < 0.1
