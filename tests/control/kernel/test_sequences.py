"""From noise to commands and back, against plain numpy: limits, control cost, weighted sums."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from disco_hw.control.kernel import BLOCK, U, aligned_zeros
from disco_hw.control.kernel.sequences import (
    Basis,
    Limits,
    add_control_cost,
    add_sampled_control_cost,
    add_weighted,
    clip,
    expand,
    mean_noise,
    pull_on_knots,
    row_sum,
    sum_lanes,
)
from disco_hw.control.optimiser import spline_basis
from disco_hw.jit import kernel_function
from tests.control import oracle
from tests.tables import thinned

B, T, C, KNOTS, HISTORY = int(BLOCK), 12, 2, 5, 3
FIRST, TAPS = spline_basis(KNOTS, T)
SPLINE = Basis(FIRST, TAPS.astype(np.float32))
WHITE = Basis(np.arange(T), None)
F32 = np.float32


@kernel_function
def run_clip(value, low, high):
    return clip(value, low, high)


@kernel_function
def run_expand(commands, state, history, nominal, noise, basis, limits):
    expand(commands, state, history, nominal, noise, U(0), basis, limits)


@kernel_function
def run_control_cost(costs, commands, history, nominal, scale):
    add_control_cost(costs, U(0), commands, history, nominal, scale)


@kernel_function
def run_drawn_control_cost(costs, noise, pull, nominal, basis, scale):
    pull_on_knots(pull, nominal, basis)
    add_sampled_control_cost(costs, U(0), noise, U(0), pull, scale)


@kernel_function
def run_weighted(sums, weights, blocks, values, stride, skip, rows):
    add_weighted(sums, weights, U(0), blocks, values, U(stride), U(skip), rows)
    sum_lanes(sums, rows)


@kernel_function
def run_mean_noise(out, sums, basis):
    for t in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[t, c] = mean_noise(sums, t, c, out.shape[1], basis)


def drawn(basis, seed):
    """Noise as the kernel lays it out, flat, and over time (B, T, C); a plan (T, C)."""
    rng = np.random.default_rng(seed)
    knots = T if basis.weights is None else KNOTS
    noise = rng.standard_normal((knots, C, B)).astype(F32)
    by_sample = noise.transpose(2, 0, 1).astype(float)
    over_time = by_sample if basis.weights is None else np.einsum("tj,ktjc->ktc", TAPS, by_sample[:, FIRST_FOUR])
    return noise.ravel(), over_time, rng.standard_normal((T, C)).astype(F32)


FIRST_FOUR = FIRST[:, None] + np.arange(4)


def expanded(basis, noise, nominal, largest, change, before):
    commands = aligned_zeros((HISTORY + T) * C * B)
    commands[:] = 77.0
    limits = Limits(F32(largest), F32(change), np.array(before, F32))
    run_expand(commands, aligned_zeros(C * B), HISTORY, nominal, noise, basis, limits)
    return commands


@thinned("basis", [SPLINE, WHITE], ids=["spline", "white"], quick=1)
@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    largest=st.floats(0.5, 6.0),
    change=st.floats(0.05, 3.0),
    before=st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)),
)
def test_commands_are_plan_plus_noise_within_the_limits(basis, seed, largest, change, before):
    noise, over_time, nominal = drawn(basis, seed)
    commands = expanded(basis, noise, nominal, largest, change, before).reshape(HISTORY + T, C, B)
    expected = oracle.limited(nominal.astype(float), over_time, np.array(before), largest, change)
    np.testing.assert_allclose(commands[HISTORY:].transpose(2, 0, 1), expected, atol=1e-5)
    assert np.all(commands[:HISTORY] == 77.0)


def test_a_command_that_is_no_number_stays_visible():
    assert [run_clip(x, -1.0, 1.0) for x in (-3.0, 0.5, 3.0)] == [-1.0, 0.5, 1.0]
    assert math.isnan(run_clip(math.nan, -1.0, 1.0))


def test_the_control_cost_is_of_the_noise_as_applied():
    noise, over_time, nominal = drawn(SPLINE, 4)
    commands = expanded(SPLINE, noise, nominal, 1.5, 0.4, (0.2, -0.1))
    costs = np.ones(B, F32)
    run_control_cost(costs, commands, HISTORY, nominal, F32(0.7))
    applied = oracle.limited(nominal.astype(float), over_time, np.array([0.2, -0.1]), 1.5, 0.4) - nominal
    np.testing.assert_allclose(costs, 1.0 + oracle.control_cost(nominal, applied, 1.0, 0.7), atol=2e-4)


@thinned("basis", [SPLINE, WHITE], ids=["spline", "white"], quick=1)
def test_or_of_the_noise_as_drawn(basis):
    noise, over_time, nominal = drawn(basis, 5)
    costs, pull = np.ones(B, F32), np.full(noise.size // B, 9.0, F32)
    run_drawn_control_cost(costs, noise, pull, nominal, basis, F32(0.7))
    np.testing.assert_allclose(costs, 1.0 + oracle.control_cost(nominal, over_time, 1.0, 0.7), atol=2e-4)


def test_weighted_sums_over_blocks_skip_what_came_before():
    rng = np.random.default_rng(6)
    blocks, rows, skip = 3, 7, 2
    values, weights = rng.standard_normal((blocks, skip + rows, B)).astype(F32), rng.random(blocks * B).astype(F32)
    sums = np.zeros((rows, B), F32)
    run_weighted(sums.reshape(-1), weights, blocks, values.ravel(), (skip + rows) * B, skip, rows)
    expected = np.einsum("nb,nrb->r", weights.reshape(blocks, B), values[:, skip:].astype(float))
    np.testing.assert_allclose(sums[:, 0], expected, atol=1e-4)


@thinned("basis", [SPLINE, WHITE], ids=["spline", "white"], quick=1)
def test_the_mean_noise_over_time_comes_from_the_sums_of_its_rows(basis):
    noise, over_time, _ = drawn(basis, 7)
    rows = noise.size // B
    sums, out = np.zeros(noise.size, F32), np.zeros((T, C), F32)
    run_weighted(sums, np.full(B, 1.0 / B, F32), 1, noise, noise.size, 0, rows)
    run_mean_noise(out, sums, basis)
    np.testing.assert_allclose(out, over_time.mean(axis=0), atol=1e-5)


@kernel_function
def run_row_sum(rows, first):
    return row_sum(rows, U(first))


@given(st.integers(0, 2**32 - 1), st.integers(0, 2))
def test_a_row_is_summed(seed, row):
    rows = np.random.default_rng(seed).uniform(-1.0, 1.0, 3 * B).astype(np.float32)
    expected = rows[row * B : (row + 1) * B].astype(float).sum()
    np.testing.assert_allclose(run_row_sum(rows, row * B), expected, atol=1e-5)


def test_what_is_not_finite_stays_visible_in_the_sum_of_a_row():
    for at in range(B):
        for value in (np.nan, np.inf):
            rows = np.zeros(B, np.float32)
            rows[at] = value
            assert not np.isfinite(run_row_sum(rows, 0))
