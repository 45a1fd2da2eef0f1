"""Weights from costs: softmax, effective sample size, the temperature for a target, costs that are not finite."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.control.kernel import BLOCK, aligned_zeros
from disco_hw.control.kernel.step import INVALID, exp_nonpositive, refuse_invalid, temperature_for, weigh
from disco_hw.jit import kernel_function
from tests.control import oracle
from tests.tables import examples

B = int(BLOCK)


@kernel_function
def run_exp(values, out):
    for i in range(values.size):
        out[i] = exp_nonpositive(values[i])


@kernel_function
def run_refuse(costs, samples):
    return refuse_invalid(costs, samples)


@kernel_function
def run_weigh(weights, scratch, costs, blocks, samples, least, temperature):
    return weigh(weights, scratch, costs, blocks, samples, least, temperature)


@kernel_function
def run_temperature(target, weights, scratch, costs, blocks, samples, least, guess):
    return temperature_for(target, weights, scratch, costs, blocks, samples, least, guess)


def buffers(costs):
    blocks = -(-len(costs) // B)
    padded = aligned_zeros(blocks * B)
    padded[: len(costs)] = costs
    return padded, aligned_zeros(blocks * B), aligned_zeros(2 * B), blocks


def test_exponential_is_accurate_and_bottoms_out():
    values = np.concatenate([np.linspace(-80.0, 0.0, 4001), [-1e30, 0.0]]).astype(np.float32)
    out = np.empty_like(values)
    run_exp(values, out)
    np.testing.assert_allclose(out[:-2], np.exp(values[:-2].astype(float)), rtol=2e-6)
    assert 0.0 <= out[-2] < 1e-37
    assert out[-1] == 1.0


COSTS = st.lists(st.floats(0.0, 50.0), min_size=30, max_size=300)


@examples(quick=25, every=60, costs=COSTS, temperature=st.floats(0.05, 20.0))
def test_weights_are_the_softmax(costs, temperature):
    costs = np.array(costs, dtype=np.float32)
    padded, weights, scratch, blocks = buffers(costs)
    total, size = run_weigh(
        weights, scratch, padded, blocks, len(costs), np.float32(costs.min()), np.float32(temperature)
    )
    expected = oracle.softmax_weights(costs.astype(float), temperature)
    np.testing.assert_allclose(weights[: len(costs)] / total, expected, atol=1e-5)
    assert not weights[len(costs) :].any()
    assert size == pytest.approx(oracle.effective_sample_size(expected), rel=1e-3)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(40, 500), st.floats(0.01, 100.0), st.floats(2.0, 30.0), st.floats(1e-3, 1e3))
def test_temperature_reaches_the_target_from_any_guess(seed, count, spread, target, guess):
    costs = (spread * np.random.default_rng(seed).gamma(2.0, size=count)).astype(np.float32)
    padded, weights, scratch, blocks = buffers(costs)
    temperature, total, size = run_temperature(
        np.float32(target), weights, scratch, padded, blocks, count, np.float32(costs.min()), guess
    )
    assert size == pytest.approx(target, rel=0.02)
    expected = oracle.softmax_weights(costs.astype(float), float(temperature))
    np.testing.assert_allclose(weights[:count] / total, expected, atol=1e-4)


@pytest.mark.parametrize("costs", [np.full(50, 3.0), np.r_[0.0, np.full(49, 1e7)], np.r_[np.zeros(40), 1.0]])
def test_targets_out_of_reach_end_at_a_finite_temperature(costs):
    padded, weights, scratch, blocks = buffers(costs.astype(np.float32))
    temperature, total, size = run_temperature(
        np.float32(20.0), weights, scratch, padded, blocks, len(costs), np.float32(costs.min()), 1.0
    )
    assert np.isfinite([temperature, total, size]).all()
    assert total > 0.0


def test_costs_that_are_not_finite_get_no_weight():
    costs = np.array([1.0, np.nan, np.inf, -np.inf, 2.0, 1e31] + [3.0] * 20, dtype=np.float32)
    padded, weights, scratch, blocks = buffers(costs)
    padded[3] = np.inf
    least, valid = run_refuse(padded, len(costs))
    assert (least, valid) == (1.0, 22)
    assert padded[1] == padded[2] == padded[5] == INVALID
    run_weigh(weights, scratch, padded, blocks, len(costs), np.float32(least), np.float32(1.0))
    assert not weights[[1, 2, 3, 5]].any()
    assert weights[0] == 1.0
