import numpy as np
import pytest

from disco_hw.adaptation.recursive import from_linear, to_linear

THETA = np.array([0.2, 0.06, 0.4])
SPREAD = np.array([[4e-6, 1e-7, 2e-7], [1e-7, 1e-6, 5e-7], [2e-7, 5e-7, 9e-6]])


def test_there_and_back():
    mean, covariance = from_linear(*to_linear(THETA, SPREAD))
    assert mean == pytest.approx(THETA, rel=1e-14)
    assert covariance == pytest.approx(SPREAD, rel=1e-12)


def test_covariance_is_that_of_draws():
    draws = np.random.default_rng(1).multivariate_normal(THETA, SPREAD, 200_000)
    x_icr, radius, axial = draws.T
    beta = np.column_stack([radius, x_icr * radius / axial, radius / axial])
    _, covariance = to_linear(THETA, SPREAD)
    assert covariance == pytest.approx(np.cov(beta.T), rel=0.03)
