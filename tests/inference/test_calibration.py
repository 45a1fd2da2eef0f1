from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.checks import LEVELS, calibrate, effective_simulations, widening
from disco_hw.inference.density_network import Mixtures, NetworkSettings, Region, RoundSettings, run_rounds

SMALL = NetworkSettings(members=2, hidden=16, epochs=60)
SD = 0.05


def simulate(theta, seeds):
    noise = np.array([np.random.default_rng(int(seed)).standard_normal(3) for seed in seeds])
    return theta + SD * noise


@pytest.fixture(scope="module")
def fitted():
    prior = Region.box(np.zeros(3), np.ones(3))
    return run_rounds(simulate, np.full(3, 0.5), prior, 1000, RoundSettings((1.0,), network=SMALL), 1)


class Narrower:
    """A network whose widths are wrong by a factor."""

    def __init__(self, network, factor):
        self.network, self.factor = network, factor

    def mixtures(self, statistics):
        found = self.network.mixtures(statistics)
        return Mixtures(found.log_weight, found.mean, found.factor * self.factor)


@pytest.mark.thorough
def test_a_good_posterior_is_calibrated(fitted):
    found = calibrate(fitted, simulate, 300, 2)
    assert found.p_values.min() > 0.001
    assert found.coverage[LEVELS.index(0.9)] == pytest.approx(0.9, abs=0.06)


def test_an_overconfident_one_is_found_out(fitted):
    found = calibrate(replace(fitted, network=Narrower(fitted.network, 2.0)), simulate, 150, 2)
    assert found.p_values.max() < 0.001
    assert found.coverage[LEVELS.index(0.9)] < 0.6


def test_a_posterior_of_wrong_width_is_put_right(fitted):
    narrow = replace(fitted, network=Narrower(fitted.network, 2.0))
    draws = np.full((400, 3), 0.5) + SD * np.random.default_rng(4).standard_normal((400, 3))
    found = widening(narrow, simulate, draws, 5)
    assert found == pytest.approx(2.0, rel=0.15)
    assert widening(fitted, simulate, draws, 5) == pytest.approx(1.0, rel=0.15)
    mended = calibrate(replace(narrow, widening=found), simulate, 300, 2)
    assert mended.p_values.min() > 0.001
    assert mended.coverage[LEVELS.index(0.9)] == pytest.approx(0.9, abs=0.06)


def test_a_widened_posterior_keeps_its_mean_and_only_grows_along_what_is_widened(fitted):
    factor = np.array([[0.5, 0.1, 0.0], [0.0, 0.4, 0.1], [0.1, 0.0, 0.3]])
    askew = replace(fitted, region=replace(fitted.region, factor=factor))
    statistics, by = np.array([[0.5, 0.45, 0.55]]), np.array([1.0, 3.0, 1.0])
    before, after = askew.posteriors(statistics), replace(askew, widening=by).posteriors(statistics)
    (mean, covariance), (same, wider) = before.moments(), after.moments()
    np.testing.assert_allclose(same, mean, atol=1e-12)
    was, found = factor @ covariance[0] @ factor.T, factor @ wider[0] @ factor.T
    np.testing.assert_allclose(found, was * np.outer(by, by), atol=1e-9 * found.max())
    samples = after.draw(50_000, np.random.default_rng(1))[0]
    np.testing.assert_allclose(np.cov(samples.T), wider[0], atol=0.03 * wider[0].max())
    # What maps to a standard normal vector stays lower triangular, as the density takes its diagonal.
    assert (np.diagonal(after.factor, axis1=2, axis2=3) > 0.0).all()
    np.testing.assert_array_equal(np.triu(after.factor, 1), 0.0)


def test_effective_simulations_count_those_near_the_posterior(fitted):
    # Of n even draws, a Gaussian is worth n (2 sqrt(pi) sd)^3.
    expected = fitted.theta.shape[0] * (2.0 * np.sqrt(np.pi) * SD) ** 3
    assert effective_simulations(fitted, np.full(3, 0.5)) == pytest.approx(expected, rel=0.6)
