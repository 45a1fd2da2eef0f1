"""Screening of pose samples and the gate's limit."""

import math

import msgspec
import pytest
from scipy.stats import chi2

from disco_hw.estimation.correction import PoseReason, gate_limit, screen
from disco_hw.estimation.odometry import Pose
from drivers.types import PoseSample

GOOD = PoseSample(t_ns=5, received_ns=7, x_m=1.0, y_m=-2.0, yaw_rad=3.0, position_std_m=0.01, yaw_std_rad=0.02)


def changed(**fields):
    return screen(msgspec.structs.replace(GOOD, **fields))


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999, 0.999999])
def test_the_limit_is_the_quantile_of_chi_square_with_three_degrees(probability):
    assert gate_limit(probability) == pytest.approx(chi2.ppf(probability, 3))


def test_a_good_sample_keeps_its_values():
    measurement = screen(GOOD)
    assert (measurement.t_ns, measurement.pose) == (5, Pose(1.0, -2.0, 3.0))
    assert measurement.position_variance == pytest.approx(1e-4)
    assert measurement.yaw_variance == pytest.approx(4e-4)
    assert not measurement.floored


@pytest.mark.parametrize("field", ["x_m", "y_m", "yaw_rad", "position_std_m", "yaw_std_rad"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_not_finite_is_refused(field, value):
    assert changed(**{field: value}) is PoseReason.NOT_FINITE


@pytest.mark.parametrize("fields", [{"x_m": 1000.1}, {"y_m": -1e9}, {"yaw_rad": 1e5}, {"x_m": 1e308, "y_m": -1e308}])
def test_absurd_values_are_refused(fields):
    assert changed(**fields) is PoseReason.OUT_OF_RANGE


@pytest.mark.parametrize("value", [0.0, -1.0, 1e-12])
def test_unusable_standard_deviations_are_raised_to_the_floor(value):
    position, yaw = changed(position_std_m=value), changed(yaw_std_rad=value)
    assert (position.position_variance, yaw.yaw_variance) == pytest.approx((1e-6, 1e-6))
    assert position.floored
    assert yaw.floored


def test_huge_standard_deviations_are_lowered_to_know_nothing():
    measurement = changed(position_std_m=1e300, yaw_std_rad=1e300)
    assert measurement.position_variance == pytest.approx(1e4)
    assert measurement.yaw_variance == pytest.approx(math.pi**2 / 3)
    assert not measurement.floored


def test_only_fused_poses_count_as_accepted():
    assert {reason for reason in PoseReason if reason.accepted} == {
        PoseReason.ACCEPTED,
        PoseReason.INITIALISED,
        PoseReason.REINITIALISED,
    }
