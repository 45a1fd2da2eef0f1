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


def test_a_direction_without_information_gets_a_large_variance():
    matrix = np.array([[4.0, 0.0], [0.0, 0.0]])
    assert inverse(matrix)[0, 0] == pytest.approx(0.25)
    assert inverse(matrix)[1, 1] > 1e8
    slope = np.eye(3)[:, :2]
    np.testing.assert_allclose(solve(slope, np.array([1.0, 2.0])), [1.0, 2.0])


def test_the_variance_of_what_is_known_badly_is_exact():
    # Two columns that are alike to a hundredth: their sum is known well, their difference badly.
    matrix = np.array([[1.0, 0.9999], [0.9999, 1.0]])
    np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(2), atol=1e-6)


def test_a_step_that_overshoots_is_made_shorter_until_it_betters_the_fit():
    # Newton's step on an arc tangent leads away from where it is zero if it begins far out.
    layout = SimpleNamespace(
        step=np.array([1e-6]), low=np.array([-1e3]), high=np.array([1e3]), neutral=np.zeros(1), precision=np.zeros(1)
    )
    bent = SimpleNamespace(settings=DEFAULT_SETTINGS, layout=layout, residual=lambda p: 100.0 * np.arctan(p))
    assert fit(bent, np.array([2.0]), (0,), 30).vector[0] == pytest.approx(0.0, abs=1e-3)


def test_blocks_in_any_order_are_each_their_own_and_may_be_taken_together():
    found = fit(channel((2.0, 0.7), noise=0.1), np.array([1.0, 0.5]), (0, 1))
    # Stretches that are left out in turn alternate along a log.
    block = (np.arange(T.size) // 40) % 2
    normal, gradient = by_block(found, block)
    for part in (0, 1):
        slope = found.jacobian[block == part]
        np.testing.assert_allclose(normal[part], slope.T @ slope)
        np.testing.assert_allclose(gradient[part], slope.T @ found.residual[block == part])
    tens = np.arange(T.size) // 40
    pairs = by_block(found, tens, 2)[0]
    np.testing.assert_allclose(pairs, by_block(found, tens)[0].reshape(5, 2, 2, 2).sum(axis=1))


def counted(of):
    """A channel that keeps the vectors at which its residual is asked for."""
    asked = []

    def residual(p):
        asked.append(p.copy())
        return of.residual(p)

    return SimpleNamespace(settings=of.settings, layout=of.layout, residual=residual), asked


def test_derivatives_where_a_fit_ends_are_taken_when_they_are_asked_for_and_once():
    curve, asked = counted(channel((2.0, 0.7), noise=0.1))
    found = fit(curve, np.array([1.0, 0.5]), (0, 1))
    before = len(asked)
    slope = found.jacobian
    assert len(asked) == before + 2
    assert found.jacobian is slope
    np.testing.assert_allclose(slope[:, 0], -np.exp(-found.vector[1] * T), rtol=1e-6)
    np.testing.assert_allclose(found.gradient, slope.T @ found.residual)
    assert len(asked) == before + 2


def test_what_begins_where_a_fit_ended_asks_for_nothing_that_is_known_there():
    curve, asked = counted(channel((2.0, 0.7), noise=0.1))
    size = fit(curve, np.array([1.0, 0.5]), (0,))
    assert size.jacobian.shape == (T.size, 1)
    asked.clear()
    plain = fit(curve, size.vector, (0, 1))
    of_plain = len(asked)
    begun = fit(curve, size, (0, 1))
    # All but the residual at the start and the derivative by the size.
    assert len(asked) - of_plain == of_plain - 2
    np.testing.assert_array_equal(begun.vector, plain.vector)
    assert begun.cost == plain.cost


def test_a_loose_fit_comes_as_near_and_asks_for_less():
    curve, asked = counted(channel((2.0, 0.7), noise=0.1))
    exact = fit(curve, np.array([1.9, 0.65]), (0, 1))
    of_exact = len(asked)
    loose = fit(curve, np.array([1.9, 0.65]), (0, 1), loose=True)
    assert len(asked) - of_exact < of_exact
    assert exact.cost <= loose.cost < exact.cost + DEFAULT_SETTINGS.fit.enough_nats
    assert loose.loose
    assert not exact.loose
    # Its derivatives are those where it ends, and not what it was fitted with.
    np.testing.assert_allclose(loose.jacobian[:, 0], -np.exp(-loose.vector[1] * T), rtol=1e-6)
