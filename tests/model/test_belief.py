"""Beliefs: moments agree with draws, and what is no distribution is refused."""

import numpy as np
import pytest

from disco_hw.model import Gaussian, Mixture, Uniform

NAMES = ("a", "b")
COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


def gaussian(mean=(1.0, 2.0), covariance=COVARIANCE):
    return Gaussian(NAMES, np.array(mean), np.array(covariance))


def mixture():
    return Mixture(np.array([3.0, 1.0]), (gaussian(), gaussian((2.0, 0.0), np.diag([0.01, 0.01]))))


@pytest.mark.parametrize("belief", [gaussian(), mixture(), Uniform(NAMES, np.array([0.0, -1.0]), np.array([1.0, 3.0]))])
def test_moments_are_those_of_the_draws(belief):
    draws = belief.draw(200_000, np.random.default_rng(1))
    np.testing.assert_allclose(draws.mean(axis=0), belief.mean(), atol=0.01)
    np.testing.assert_allclose(np.cov(draws.T), belief.covariance(), atol=0.02)


def test_mixture_normalises_and_finds_its_dominant_component():
    weight, component = mixture().dominant()
    assert weight == pytest.approx(0.75)
    np.testing.assert_array_equal(component.means, [1.0, 2.0])


def test_draws_repeat_with_the_generator():
    one, other = (mixture().draw(10, np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_arrays_cannot_be_changed_from_outside():
    with pytest.raises(ValueError, match="read-only"):
        gaussian().means[0] = 5.0


@pytest.mark.parametrize(
    ("mean", "covariance", "fault"),
    [
        ((1.0, np.nan), COVARIANCE, "mean holds a value that is not finite"),
        ((1.0,), COVARIANCE, "mean has 1 entries, not 2"),
        ((1.0, 2.0), [[0.04, np.inf], [np.inf, 0.09]], "covariance holds a value that is not finite"),
        ((1.0, 2.0), [[0.04, 0.01], [0.02, 0.09]], "covariance is not symmetric"),
        ((1.0, 2.0), [[0.04, 0.08], [0.08, 0.09]], "covariance is not positive definite"),
        ((1.0, 2.0), [[0.04]], r"covariance has shape \(1, 1\), not \(2, 2\)"),
    ],
)
def test_gaussian_refuses(mean, covariance, fault):
    with pytest.raises(ValueError, match=fault):
        gaussian(mean, covariance)


def test_mixture_and_uniform_refuse():
    with pytest.raises(ValueError, match="at least one component"):
        Mixture(np.array([]), ())
    with pytest.raises(ValueError, match="weights must all be positive"):
        Mixture(np.array([1.0, 0.0]), (gaussian(), gaussian()))
    with pytest.raises(ValueError, match="name different parameters"):
        Mixture(np.array([1.0, 1.0]), (gaussian(), Gaussian(("a", "c"), np.zeros(2), COVARIANCE)))
    with pytest.raises(ValueError, match="low must be below high"):
        Uniform(("a",), np.array([1.0]), np.array([1.0]))
