"""From costs under each parameter point to one cost: mean, mean of the worst part, worst."""

import numpy as np
import pytest

from disco_hw.control.kernel import BLOCK, aligned_zeros
from disco_hw.control.kernel.step import mean_over_points, worst_over_points
from disco_hw.jit import kernel_function
from tests.control import oracle

B = int(BLOCK)


@kernel_function
def run_mean(costs, point_costs, weights, blocks):
    mean_over_points(costs, point_costs, weights, blocks)


@kernel_function
def run_worst(costs, point_costs, weights, blocks, part, order):
    worst_over_points(costs, point_costs, weights, blocks, part, order)


def worst(point_costs, weights, part):
    """Costs (B,) of the worst part under all points."""
    costs = aligned_zeros(B)
    run_worst(costs, point_costs.ravel(), weights, 1, np.float32(part), np.zeros(7, np.int64))
    return costs


@pytest.fixture
def case():
    rng = np.random.default_rng(3)
    weights = rng.uniform(0.1, 1.0, 7)
    return rng.gamma(2.0, size=(7, B)).astype(np.float32), (weights / weights.sum()).astype(np.float32)


def test_mean_adds_to_what_is_there(case):
    point_costs, weights = case
    costs = aligned_zeros(B)
    costs[:] = 1.0
    run_mean(costs, point_costs.ravel(), weights, 1)
    np.testing.assert_allclose(costs, 1.0 + oracle.mean_risk(point_costs, weights), rtol=1e-5)


@pytest.mark.parametrize("part", [0.05, 0.25, 0.6, 0.99])
def test_cvar_is_the_mean_of_the_worst_part(case, part):
    np.testing.assert_allclose(worst(*case, part), oracle.cvar_risk(*case, part), rtol=1e-5)


def test_a_vanishing_part_is_the_worst_point_of_a_weight(case):
    point_costs, weights = case
    np.testing.assert_allclose(worst(point_costs, weights, 1e-6), point_costs.max(axis=0), rtol=1e-6)
    weights[0], point_costs[0] = 0.0, 1e3
    np.testing.assert_allclose(worst(point_costs, weights, 1e-6), point_costs[1:].max(axis=0), rtol=1e-6)


@pytest.mark.parametrize("place", [0, 3, 6])
@pytest.mark.parametrize("part", [1e-6, 0.25])
def test_a_point_under_which_a_sequence_has_no_cost_is_its_worst(case, part, place):
    point_costs, weights = case
    point_costs[place, 5] = np.nan
    assert np.flatnonzero(np.isnan(worst(point_costs, weights, part))).tolist() == [5]
