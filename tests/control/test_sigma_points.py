"""Sigma points: exact moments, correlated or not; the weights of the paper's settings."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.control.parameter_points import sigma_points
from disco_hw.model import load_model

PAPER = load_model(Path(__file__).parents[2] / "disco_hw/robots/wombot_model.toml").belief


def covariance_of(sigma, mean):
    offsets = sigma.points - mean
    return np.einsum("l,li,lj->ij", sigma.mean_weights, offsets, offsets)


@pytest.mark.parametrize("alpha", [0.3, 0.5, 1.0])
def test_the_papers_correlated_posterior_is_matched_exactly(alpha):
    sigma = sigma_points(PAPER.mean(), PAPER.covariance(), alpha)
    assert sigma.points.shape == (7, 3)
    np.testing.assert_allclose(sigma.mean_weights @ sigma.points, PAPER.mean(), rtol=1e-12)
    np.testing.assert_allclose(covariance_of(sigma, PAPER.mean()), PAPER.covariance(), rtol=0, atol=1e-12)
    off = np.abs(covariance_of(sigma, PAPER.mean()) - PAPER.covariance()).max()
    assert off < 1e-12 * PAPER.covariance().max() / alpha**2


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 6), st.floats(0.3, 1.0), st.integers(0, 10_000))
def test_any_covariance_is_matched_exactly(n, alpha, seed):
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((n, n)) + 2.0 * np.eye(n)
    mean, covariance = rng.standard_normal(n), factor @ factor.T + 1e-3 * np.eye(n)
    sigma = sigma_points(mean, covariance, alpha)
    np.testing.assert_allclose(sigma.mean_weights.sum(), 1.0, atol=1e-12)
    np.testing.assert_allclose(sigma.mean_weights @ sigma.points, mean, atol=1e-10)
    np.testing.assert_allclose(covariance_of(sigma, mean), covariance, atol=1e-12 * covariance.max() / alpha**2)


@settings(max_examples=50, deadline=None)
@given(st.integers(2, 5), st.floats(0.3, 1.0), st.integers(0, 10_000))
def test_in_any_coordinates_the_covariance_is_the_same_and_the_last_points_lie_along_the_last_axis(n, alpha, seed):
    rng = np.random.default_rng(seed)
    factor, basis = (rng.standard_normal((n, n)) + 2.0 * np.eye(n) for _ in range(2))
    if np.linalg.cond(basis) > 100.0:
        basis = np.eye(n)
    mean, covariance = rng.standard_normal(n), factor @ factor.T + 1e-3 * np.eye(n)
    sigma = sigma_points(mean, covariance, alpha, basis=basis)
    np.testing.assert_allclose(covariance_of(sigma, mean), covariance, atol=1e-10 * covariance.max() / alpha**2)
    along = (sigma.points[n] - mean) / np.linalg.norm(sigma.points[n] - mean)
    assert abs(along @ basis[:, -1]) / np.linalg.norm(basis[:, -1]) == pytest.approx(1.0)


def test_weights_are_the_papers():
    half = sigma_points(np.zeros(3), np.eye(3), 0.5)
    np.testing.assert_allclose(half.mean_weights, [-3.0] + [2 / 3] * 6)
    assert half.covariance_weights[0] == pytest.approx(-3.0 + 1.0 - 0.25 + 2.0)
    np.testing.assert_allclose(np.abs(half.points[1:]).max(axis=1), 0.5 * np.sqrt(3.0))
    assert np.all(sigma_points(np.zeros(3), np.eye(3), 1.0).mean_weights >= 0.0)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="not positive definite"):
        sigma_points(np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]), 1.0)
    with pytest.raises(ValueError, match="alpha must be positive"):
        sigma_points(np.zeros(2), np.eye(2), 0.0)
