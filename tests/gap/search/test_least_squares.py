"""Least squares within bounds, and normal equations by block."""

from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.search.least_squares import by_block, fit, inverse, solve
from disco_hw.gap.settings import DEFAULT_SETTINGS

T = np.linspace(0.0, 4.0, 400)


def channel(truth, low=-10.0, high=10.0, noise=0.0, precision=0.0):
    rng = np.random.default_rng(0)
    y = truth[0] * np.exp(-truth[1] * T) + noise * rng.standard_normal(T.size)
    layout = SimpleNamespace(
        step=np.array([1e-5, 1e-5]), low=np.full(2, low), high=np.full(2, high), neutral=np.zeros(2),
        precision=np.array([0.0, precision]),
    )  # fmt: skip
    return SimpleNamespace(settings=DEFAULT_SETTINGS, layout=layout, residual=lambda p: y - p[0] * np.exp(-p[1] * T))


def test_a_smooth_curve_is_found_from_afar():
    found = fit(channel((2.0, 0.7)), np.array([0.5, 0.1]), (0, 1), 30)
    np.testing.assert_allclose(found.vector, [2.0, 0.7], rtol=1e-3)
    assert found.cost < 1e-4


def test_bounds_hold_and_what_is_not_active_stays():
    found = fit(channel((2.0, 0.7), high=1.5), np.array([0.5, 0.1]), (0, 1))
    assert found.vector[0] == 1.5
    assert fit(channel((2.0, 0.7)), np.array([2.0, 0.1]), (0,)).vector[1] == 0.1


def test_what_is_not_told_stays_near_what_is_expected_and_what_is_told_is_fitted():
    # Without a size the rate of decay changes nothing.
    blind = fit(channel((0.0, 0.7), precision=100.0), np.array([0.0, 0.7]), (0, 1))
    assert abs(blind.vector[1]) < 1e-3
    assert np.sqrt(blind.covariance()[1, 1]) == pytest.approx(0.1, rel=0.01)
    told = fit(channel((200.0, 0.7), high=1e3, precision=100.0), np.array([100.0, 0.5]), (0, 1), 30)
    assert told.vector[1] == pytest.approx(0.7, rel=1e-3)


def test_blocks_add_up_to_the_whole():
    found = fit(channel((2.0, 0.7), noise=0.1), np.array([1.0, 0.5]), (0, 1))
    normal, gradient = by_block(found, np.arange(T.size) // 40)
    assert normal.shape == (10, 2, 2)
    np.testing.assert_allclose(normal.sum(axis=0), found.information())
    np.testing.assert_allclose(gradient.sum(axis=0), found.jacobian.T @ found.residual)


def test_a_direction_without_information_gets_a_large_variance():
    matrix = np.array([[4.0, 0.0], [0.0, 0.0]])
    assert inverse(matrix)[0, 0] == pytest.approx(0.25)
    assert inverse(matrix)[1, 1] > 1e8
    slope = np.eye(3)[:, :2]
    np.testing.assert_allclose(solve(slope, np.array([1.0, 2.0])), [1.0, 2.0])
