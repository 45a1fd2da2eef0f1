import numpy as np
import pytest
import torch

from disco_hw.inference.density_network import Mixtures, NetworkSettings, train

SMALL = NetworkSettings(members=2, hidden=16, epochs=40)


def linear_problem(count, seed=0):
    """Uniform targets seen through correlated Gaussian noise: the posterior is that noise turned round."""
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-1.0, 1.0, (count, 2))
    noise = rng.standard_normal((count, 2)) @ np.array([[0.1, 0.0], [0.08, 0.06]]).T
    return 3.0 + 10.0 * (targets + noise), targets


def test_a_linear_problem_is_learned_with_its_correlation():
    statistics, targets = linear_problem(1500)
    mixtures = train(statistics, targets, SMALL, 1).mixtures(np.array([[3.0 + 2.0, 3.0 - 3.0]]))
    draws = mixtures.draw(20000, np.random.default_rng(0))[0]
    assert draws.mean(axis=0) == pytest.approx([0.2, -0.3], abs=0.03)
    assert np.cov(draws.T) == pytest.approx(np.array([[0.01, 0.008], [0.008, 0.01]]), rel=0.3)


@pytest.mark.thorough
def test_two_hills_are_both_found():
    rng = np.random.default_rng(0)
    targets = rng.uniform(-1.0, 1.0, (1500, 1))
    statistics = np.abs(targets) + 0.05 * rng.standard_normal(targets.shape)
    settings = NetworkSettings(members=2, hidden=16, epochs=150, patience=50, rate=1e-2, decay=0.0)
    mixtures = train(statistics, targets, settings, 1).mixtures(np.array([[0.6]]))
    left, middle, right = np.exp(mixtures.log_density(np.array([[[-0.6], [0.0], [0.6]]])))[0]
    assert left > 3.0 * middle
    assert right > 3.0 * middle


def test_the_same_seed_trains_the_same_network_and_leaves_the_generator_alone():
    statistics, targets = linear_problem(300)
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    one, other = (train(statistics, targets, SMALL, 3).mixtures(statistics[:5]).mean for _ in range(2))
    assert np.array_equal(one, other)
    assert torch.equal(before, torch.random.get_rng_state())


def test_density_and_draws_of_a_mixture_agree():
    factor = np.array([[[[2.0, 0.0], [1.0, 4.0]], [[1.0, 0.0], [0.0, 1.0]]]])
    mixtures = Mixtures(np.log([[0.25, 0.75]]), np.array([[[0.0, 0.0], [5.0, 5.0]]]), factor)
    grid = np.linspace(-6.0, 12.0, 361)
    points = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(1, -1, 2)
    mass = np.exp(mixtures.log_density(points)).reshape(361, 361) * 0.05**2
    assert mass.sum() == pytest.approx(1.0, abs=1e-3)
    draws = mixtures.draw(40000, np.random.default_rng(0))[0]
    low = draws[draws.sum(axis=1) < 5.0]
    assert low.shape[0] / draws.shape[0] == pytest.approx(0.25, abs=0.01)
    assert np.cov(low.T) == pytest.approx(np.linalg.inv(factor[0, 0].T @ factor[0, 0]), rel=0.15, abs=0.01)


def test_a_statistic_that_never_changes_does_no_harm():
    statistics, targets = linear_problem(300)
    constant = np.column_stack([statistics, np.full(300, 7.0)])
    assert np.isfinite(train(constant, targets, SMALL, 1).mixtures(constant[:3]).mean).all()
