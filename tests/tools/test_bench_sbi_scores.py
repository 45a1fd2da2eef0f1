"""Scores that distinguish a sharper posterior from a blunter one, whatever lies outside the region."""

import numpy as np
import pytest

from disco_hw.inference.density_network import Mixtures, Region
from tools.bench.sbi_scores import _log_inside, paired

BOX = Region.box(np.full(3, -1.0), np.ones(3))


def draws(mean, sd, count=600):
    """Draws for `count` simulations of one Gaussian."""
    given = Mixtures(np.zeros((count, 1)), np.full((count, 1, 3), mean), np.full((count, 1, 3, 3), np.eye(3) / sd))
    rng = np.random.default_rng(0)
    return lambda piece: Mixtures(given.log_weight[piece], given.mean[piece], given.factor[piece]).draw(400, rng)


@pytest.mark.parametrize(("mean", "share"), [(0.0, 1.0), (1.0, 0.5**3)])
def test_what_is_outside_the_region_is_found(mean, share):
    found = _log_inside(draws(mean, 0.1), BOX, 600)
    assert found.shape == (600,)
    assert np.exp(found).mean() == pytest.approx(share, abs=0.01)


def test_a_posterior_that_is_all_outside_counts_as_one_draw_inside():
    assert _log_inside(draws(9.0, 0.1), BOX, 600) == pytest.approx(np.full(600, np.log(1 / 400)))


def test_a_paired_difference_has_the_error_of_its_differences():
    common = np.random.default_rng(0).standard_normal(1000) * 50.0
    off = np.tile([0.1, 0.3], 500)
    mean, error = paired(common + off, common)
    assert mean == pytest.approx(0.2)
    assert error == pytest.approx(0.1 / np.sqrt(1000), rel=0.01)
