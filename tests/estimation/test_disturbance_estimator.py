"""Motion beside the geometry: each part is found in its own frame, and the estimate of the pose does not lag."""

from __future__ import annotations

import math

import pytest

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.correction import LARGEST_LEFT, DisturbanceEstimator
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.model.coefficients import NO_DISTURBANCE, Disturbance
from drivers.types import PoseSample, WheelSample

PARAMETERS = OdometryParameters(0.06, 0.4, 0.2)
LEFT_RAD_S, RIGHT_RAD_S, STEP_S = 2.5, 4.2, 0.02


def driven(true: Disturbance, duration_s: float, jump_m: float = 0.0):
    """Return what is estimated of a robot that turns and is disturbed so, and the last error of its place (m)."""
    fusion, estimator = PoseFusion(Estimation(), PARAMETERS, 0.1), DisturbanceEstimator()
    axle_x, axle_y, yaw = 0.2, 0.0, 0.0
    left, right = true.turning(LEFT_RAD_S, RIGHT_RAD_S, PARAMETERS.axial_distance_m)
    speed, turn = 0.03 * (left + right), 0.06 * (right - left) / 0.4
    x = y = 0.0
    for k in range(round(duration_s / STEP_S)):
        now_ns = round(k * STEP_S * 1e9)
        angles = LEFT_RAD_S * k * STEP_S, RIGHT_RAD_S * k * STEP_S
        fusion.add_wheels(WheelSample(now_ns, now_ns, *angles, LEFT_RAD_S, RIGHT_RAD_S))
        x, y = axle_x - 0.2 * math.cos(yaw), axle_y - 0.2 * math.sin(yaw)
        off_m = jump_m if 2 * k > round(duration_s / STEP_S) else 0.0
        sample = PoseSample(now_ns, now_ns, x + off_m, y, math.remainder(yaw, math.tau), 0.003, 0.004)
        estimator.add_sample(sample, fusion.add_pose(sample, now_ns), PARAMETERS, fusion.wheels_rad_s)
        fusion.set_disturbance(estimator.value)
        middle = yaw + 0.5 * turn * STEP_S
        axle_x += STEP_S * (speed * (math.cos(middle) - true.left * math.sin(middle)) + true.drift_x_m_s)
        axle_y += STEP_S * (speed * (math.sin(middle) + true.left * math.cos(middle)) + true.drift_y_m_s)
        yaw += turn * STEP_S
    found = fusion.estimate(round((duration_s - STEP_S) * 1e9))
    return estimator, math.hypot(found.x_m - x, found.y_m - y)


@pytest.mark.long
@pytest.mark.parametrize(
    "true",
    [
        Disturbance(drift_y_m_s=-0.02),
        Disturbance(curvature_per_m=-0.15),
        Disturbance(left=0.1),
        Disturbance(forward=0.08),
    ],
)
def test_each_part_is_found_where_it_is_constant(true):
    estimator, off_m = driven(true, 120.0)
    found = estimator.value
    for name, near in [("forward", 0.01), ("left", 0.015), ("curvature_per_m", 0.015), ("drift_x_m_s", 0.002)]:
        assert getattr(found, name) == pytest.approx(getattr(true, name), abs=near), name
    assert found.drift_y_m_s == pytest.approx(true.drift_y_m_s, abs=0.002)
    assert off_m < 0.001


def test_an_estimate_stays_within_its_bounds():
    estimator, _ = driven(Disturbance(left=0.8), 10.0)
    assert abs(estimator.value.left) <= LARGEST_LEFT


def test_a_robot_that_was_carried_begins_anew():
    estimator, _ = driven(Disturbance(left=0.1), 12.0)
    assert abs(estimator.value.left) > 0.04
    carried, _ = driven(Disturbance(left=0.1), 12.0 + STEP_S, jump_m=3.0)
    assert abs(carried.value.left) < abs(estimator.value.left)


def test_another_geometry_takes_off_what_it_explains_and_no_more():
    estimator, _ = driven(Disturbance(curvature_per_m=-0.15), 15.0)
    before = estimator.value.curvature_per_m
    wider = OdometryParameters(0.06, 0.42, 0.2)
    estimator.change_geometry(PARAMETERS, wider, (LEFT_RAD_S, RIGHT_RAD_S))
    assert before < estimator.value.curvature_per_m <= 0.0
    estimator.change_geometry(PARAMETERS, OdometryParameters(0.06, 0.8, 0.2), (LEFT_RAD_S, RIGHT_RAD_S))
    assert estimator.value.curvature_per_m == 0.0


def test_wheels_asked_for_turn_the_robot_as_wanted():
    found = Disturbance(0.05, 0.0, 0.2, 0.0, 0.0)
    assert found.commanded(*found.turning(2.0, 3.0, 0.4), 0.4) == pytest.approx((2.0, 3.0))
    assert NO_DISTURBANCE.is_none
    assert not found.is_none
