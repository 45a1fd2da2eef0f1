from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.checks import LEVELS, calibrate, effective_simulations
from disco_hw.inference.density_network import Mixtures, NetworkSettings, Region, RoundSettings, run_rounds

SMALL = NetworkSettings(members=2, hidden=16, epochs=60)
SD = 0.05


def simulate(theta, seeds):
    noise = np.array([np.random.default_rng(int(seed)).standard_normal(3) for seed in seeds])
    return theta + SD * noise


@pytest.fixture(scope="module")
def fitted():
    prior = Region.box(np.zeros(3), np.ones(3))
    return run_rounds(simulate, np.full(3, 0.5), prior, 1500, RoundSettings((1.0,), network=SMALL), 1)


class Narrower:
    """A network whose widths are wrong by a factor."""

    def __init__(self, network, factor):
        self.network, self.factor = network, factor

    def mixtures(self, statistics):
        found = self.network.mixtures(statistics)
        return Mixtures(found.log_weight, found.mean, found.factor * self.factor)


def test_a_good_posterior_is_calibrated(fitted):
    found = calibrate(fitted, simulate, 300, 2)
    assert found.p_values.min() > 0.001
    assert found.coverage[LEVELS.index(0.9)] == pytest.approx(0.9, abs=0.06)


def test_an_overconfident_one_is_found_out(fitted):
    found = calibrate(replace(fitted, network=Narrower(fitted.network, 2.0)), simulate, 300, 2)
    assert found.p_values.max() < 0.001
    assert found.coverage[LEVELS.index(0.9)] < 0.6


def test_effective_simulations_count_those_near_the_posterior(fitted):
    # Of n even draws, a Gaussian is worth n (2 sqrt(pi) sd)^3.
    expected = fitted.theta.shape[0] * (2.0 * np.sqrt(np.pi) * SD) ** 3
    assert effective_simulations(fitted, np.full(3, 0.5)) == pytest.approx(expected, rel=0.6)
