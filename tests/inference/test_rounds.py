from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.density_network import NetworkSettings, Region, RoundSettings, run_rounds

PRIOR = Region.box(np.zeros(2), np.ones(2))
SMALL = NetworkSettings(members=2, hidden=16, epochs=40)
SETTINGS = RoundSettings(scout=SMALL, network=SMALL)
SD = 0.004


def simulate(theta, seeds):
    noise = np.array([np.random.default_rng(int(seed)).standard_normal(2) for seed in seeds])
    return np.column_stack([theta[:, 0] ** 2, theta.sum(axis=1)]) + SD * noise


def observed(truth):
    return np.array([truth[0] ** 2, truth.sum()])


def test_rounds_close_in_on_a_posterior_far_narrower_than_the_prior():
    truth = np.array([0.6, 0.3])
    fitted = run_rounds(simulate, observed(truth), PRIOR, 800, SETTINGS, 1)
    draws, outside = fitted.draw(observed(truth)[None], 4000, np.random.default_rng(0))
    jacobian = np.array([[1.2, 0.0], [1.0, 1.0]])
    exact = SD * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    assert draws[0].mean(axis=0) == pytest.approx(truth, abs=1.5 * SD)
    assert draws[0].std(axis=0) == pytest.approx(exact, rel=0.35)
    assert outside[0] < 0.02
    assert fitted.simulations == 800


@pytest.mark.thorough
def test_one_round_is_blunter_than_several():
    truth = np.array([0.6, 0.3])

    def spread(settings):
        fitted = run_rounds(simulate, observed(truth), PRIOR, 600, settings, 1)
        return fitted.draw(observed(truth)[None], 2000, np.random.default_rng(0))[0][0].std(axis=0)

    assert (spread(SETTINGS) < 0.8 * spread(replace(SETTINGS, shares=(1.0,)))).any()


@pytest.mark.thorough
def test_a_posterior_at_the_priors_edge_stays_inside():
    truth = np.array([1.0, 0.3])
    fitted = run_rounds(simulate, observed(truth), PRIOR, 800, SETTINGS, 1)
    draws, _ = fitted.draw(observed(truth)[None], 2000, np.random.default_rng(0))
    assert draws.max() <= 1.0
    assert draws[0, :, 0].mean() == pytest.approx(1.0, abs=2.0 * SD)


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_posterior():
    first, second = (
        run_rounds(simulate, observed(np.array([0.5, 0.5])), PRIOR, 400, SETTINGS, 7).theta for _ in range(2)
    )
    assert np.array_equal(first, second)
