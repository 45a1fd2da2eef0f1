"""The mixture over headings: what it holds before anything is known of the heading, and its mean and covariance."""

import math

import numpy as np
import pytest

from disco_hw.config import Estimation
from disco_hw.estimation.correction import Measurement
from disco_hw.estimation.filter import HeadingSearch, any_heading
from disco_hw.estimation.odometry import OdometryParameters, Pose, PoseBelief, motion_model

MODEL = motion_model(Estimation(), OdometryParameters(0.061, 0.415, 0.238))
LEVER = (0.3, -0.2)


def turn_by(angle_rad):
    """Return the matrix (2, 2) that turns a vector by this angle, counter-clockwise."""
    return np.array([[math.cos(angle_rad), -math.sin(angle_rad)], [math.sin(angle_rad), math.cos(angle_rad)]])


def components(rng, count, sensitive):
    """Means (count, 3), covariances (count, 3, 3), sensitivities (count, 3, 3), and the beliefs with them."""
    means = rng.normal(size=(count, 3)) * (0.5, 0.3, 0.2)
    roots = 0.1 * rng.normal(size=(count, 3, 3))
    by_parameters = 0.1 * rng.normal(size=(count, 3, 3))
    own = np.einsum("kij,klj->kil", roots, roots)
    covariances = own + np.einsum("kij,klj->kil", by_parameters, by_parameters) * sensitive
    rows, columns = np.triu_indices(3)
    beliefs = tuple(
        PoseBelief(*mean, *part[rows, columns], tuple(by.flatten()) if sensitive else None)
        for mean, part, by in zip(means.tolist(), own, by_parameters, strict=True)
    )
    return means, covariances, by_parameters, beliefs


@pytest.mark.parametrize("sensitive", [True, False])
def test_what_is_merged_has_the_mean_and_the_covariance_of_the_mixture(sensitive):
    means, covariances, by_parameters, beliefs = components(np.random.default_rng(3), 4, sensitive)
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    merged = HeadingSearch(beliefs, tuple(weights)).merged()
    x_m, y_m, _ = weights @ means
    yaw_rad = np.angle(weights @ np.exp(1j * means[:, 2]))
    assert (merged.x_m, merged.y_m, merged.yaw_rad) == pytest.approx((x_m, y_m, yaw_rad))
    apart = means - (x_m, y_m, yaw_rad)
    expected = np.einsum("k,kij->ij", weights, covariances + np.einsum("ki,kj->kij", apart, apart))
    np.testing.assert_allclose(merged.covariance, expected, rtol=1e-9)
    if sensitive:
        np.testing.assert_allclose(np.reshape(merged.sensitivity, (3, 3)), np.einsum("k,kij", weights, by_parameters))


def test_a_component_without_sensitivity_leaves_the_whole_without():
    _, _, _, (one, _) = components(np.random.default_rng(4), 2, sensitive=True)
    _, _, _, (other, _) = components(np.random.default_rng(5), 2, sensitive=False)
    assert HeadingSearch((one, other), (0.5, 0.5)).merged().sensitivity is None


def test_all_headings_begin_equally_likely():
    search = any_heading(Measurement(0, Pose(1.0, 2.0, 0.0), 1e-4, None, False), MODEL)
    assert sum(search.weights) == pytest.approx(1.0)
    at_rad = np.linspace(-math.pi, math.pi, 1000)
    density = np.zeros_like(at_rad)
    for weight, belief in zip(search.weights, search.beliefs, strict=True):
        std_rad = math.sqrt(belief.covariance[2][2])
        apart = np.angle(np.exp(1j * (at_rad - belief.yaw_rad)))
        density += weight * np.exp(-0.5 * (apart / std_rad) ** 2) / (math.sqrt(math.tau) * std_rad)
    np.testing.assert_allclose(density, 1.0 / math.tau, rtol=0.015)


def test_whatever_the_heading_the_sensor_is_where_it_was_measured():
    search = any_heading(Measurement(0, Pose(1.0, 2.0, 0.0), 1e-4, None, False, *LEVER), MODEL)
    for belief in search.beliefs:
        arm_m = turn_by(belief.yaw_rad) @ LEVER
        assert (belief.x_m + arm_m[0], belief.y_m + arm_m[1]) == pytest.approx((1.0, 2.0))
        # How the sensor's place depends on the pose: a robot turned further lies elsewhere, and the sensor does not.
        by_pose = np.column_stack([np.eye(2), turn_by(0.5 * math.pi) @ arm_m])
        np.testing.assert_allclose(by_pose @ belief.covariance @ by_pose.T, 1e-4 * np.eye(2), atol=1e-12)
