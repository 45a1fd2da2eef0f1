"""Evidence is honest about noise that is not what the model says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from disco_hw.gap.search.evidence import EffectEvidence, compare, held_out_by_block, inflation, interval_inflation
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.tables import thinned

N, EACH = 3000, 50


def linear_fit(columns, y):
    active = tuple(range(columns.shape[1]))
    coefficient = np.linalg.lstsq(columns, y, rcond=None)[0] if active else np.empty(0)
    residual = columns @ coefficient - y
    return Fit(coefficient, active, 0.5 * float(residual @ residual), residual, columns)


BLOCK = np.arange(N) // EACH
EMPTY = np.empty((N, 0))


def channel(trusted_blocks=6.0, count=N, block=BLOCK, **selection):
    """A channel whose residuals lie in these blocks of time, and how it selects."""
    settings = replace(DEFAULT_SETTINGS, selection=replace(DEFAULT_SETTINGS.selection, **selection))
    return SimpleNamespace(settings=settings, block=block, count=count, trusted_blocks=trusted_blocks)


def wandering(rng):
    """Noise (N,) that is the same all through each block."""
    return np.repeat(rng.standard_normal(N // EACH), EACH)


def test_white_noise_speaks_for_nothing_and_a_real_slope_for_itself():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((N, 1))
    noise = rng.standard_normal(N)
    nothing, real = (
        compare(linear_fit(EMPTY, y), linear_fit(x, y), channel(), 1.0) for y in (noise, noise + 0.2 * x[:, 0])
    )
    assert nothing.score < 0.0
    assert real.score > 50.0
    assert real.held_out_without_best > 0.0
    assert real.held_out == pytest.approx(real.gain, rel=0.2)


@pytest.mark.parametrize("size", [1e-90, 0.0])
def test_what_is_told_of_next_to_nothing_is_judged_without_a_fault(size):
    white = np.random.default_rng(5).standard_normal(N)
    with np.errstate(all="raise"):
        assert inflation(linear_fit(np.full((N, 1), size), white), channel(), (0,)) == 1.0


def test_a_block_is_judged_by_the_others():
    rng = np.random.default_rng(2)
    x = np.zeros((N, 1))
    x[:EACH] = 1.0
    y = rng.standard_normal(N) + 3.0 * x[:, 0]
    fitted = linear_fit(x, y)
    proof = compare(linear_fit(EMPTY, y), fitted, channel(), 1.0)
    # Only one block speaks for it: without that one nothing repeats.
    assert proof.gain > 100.0
    assert proof.held_out_without_best <= 1e-6
    assert held_out_by_block(fitted, channel()).size == N // EACH


def test_what_only_one_block_knows_does_not_hide_what_all_show():
    rng = np.random.default_rng(3)
    everywhere = rng.standard_normal((N, 1))
    limit = np.full((N, 1), 1e-7)
    limit[:EACH] = 1.0
    y = rng.standard_normal(N) + 0.3 * everywhere[:, 0] + 2.0 * limit[:, 0]
    both = linear_fit(np.hstack([limit, everywhere]), y)
    proof = compare(linear_fit(limit, y), both, channel(), 1.0)
    assert proof.held_out == pytest.approx(proof.gain, rel=0.2)
    assert proof.held_out_without_best > 50.0


def test_few_blocks_that_happen_to_scatter_do_not_take_the_evidence_away():
    rng = np.random.default_rng(4)
    # Nearly all is told in two of 20 blocks of nine.
    x = np.full((9000, 1), 0.02)
    x[:450] = x[4500:4950] = 1.0
    wide = channel(count=9000, block=np.arange(9000) // EACH)
    factors = [inflation(linear_fit(x, rng.standard_normal(9000)), wide, (0,)) for _ in range(100)]
    assert np.quantile(factors, 0.95) < 2.0
    assert np.mean(factors) == pytest.approx(1.15, abs=0.15)


def test_the_cost_of_a_block_is_that_of_a_fit_without_it():
    rng = np.random.default_rng(6)
    x = rng.standard_normal((N, 2)) * (1.0, 0.3)
    y = x @ (0.5, -2.0) + rng.standard_normal(N)
    blocks = held_out_by_block(linear_fit(x, y), channel())
    expected = []
    for b in range(N // EACH):
        out = b == BLOCK
        coefficient = np.linalg.lstsq(x[~out], y[~out], rcond=None)[0]
        expected.append(0.5 * float(((x[out] @ coefficient - y[out]) ** 2).sum()))
    np.testing.assert_allclose(blocks, expected, rtol=1e-9)


def test_a_score_is_twice_the_gain_over_its_inflation_less_the_price_of_its_parameters():
    x = np.random.default_rng(7).standard_normal((N, 1))
    y = 0.1 * x[:, 0] + np.random.default_rng(8).standard_normal(N)
    small, big = linear_fit(EMPTY, y), linear_fit(x, y)
    proof = compare(small, big, channel(), 2.0)
    expected = 2.0 * (small.cost - big.cost) / proof.inflation - 2.0 * np.log(N)
    assert proof.score == pytest.approx(expected, rel=1e-12)
    assert inflation(big, channel(), ()) == 1.0


@pytest.mark.parametrize("trusted", [0.5, 6.0])
@pytest.mark.parametrize("added", [(0,), (0, 1)])
def test_the_inflation_is_the_scatter_of_blocks_over_what_noise_alone_would_scatter(trusted, added):
    rng = np.random.default_rng(9)
    x = rng.standard_normal((N, 2)) * np.repeat(rng.uniform(0.2, 2.0, N // EACH), EACH)[:, None]
    found = linear_fit(x, rng.standard_normal(N) + wandering(rng))
    of = channel(trusted)
    covariance = np.linalg.inv(x.T @ x)
    root = np.linalg.cholesky(np.linalg.inv(covariance[np.ix_(added, added)])).T @ covariance[list(added)]
    expected = [1.0]
    for length in DEFAULT_SETTINGS.selection.block_lengths:
        group = BLOCK // length
        blocks = [group == b for b in np.unique(group)]
        if len(blocks) < DEFAULT_SETTINGS.selection.fewest_blocks:
            continue
        # What each block alone moves the estimate by, in units of its standard deviation, and what noise would.
        squares = sum(((root @ x[b].T @ found.residual[b]) ** 2).sum() for b in blocks)
        told = np.array([((root @ x[b].T) ** 2).sum() for b in blocks])
        effective, known = told.sum() ** 2 / (told**2).sum(), trusted / len(added)
        expected.append((known + effective * squares / len(added)) / (known + effective - 1.0))
    assert len(expected) > 2
    assert inflation(found, of, added) == pytest.approx(max(expected), rel=1e-6)
    assert max(expected) > 1.5


def shown_in(blocks, trusted, rng):
    """A parameter that so many blocks of time show, of 60, under noise that wanders from block to block."""
    x = np.where(np.arange(N) < blocks * EACH, 1.0, 0.0)[:, None]
    return linear_fit(x, rng.standard_normal(N) + 2.0 * wandering(rng)), channel(trusted, block_lengths=(1,))


@pytest.mark.parametrize(("blocks", "trusted"), [(2, 1.0), (3, 1.0), (3, 6.0), (60, 1.0)])
def test_an_interval_is_students_by_as_many_blocks_as_tell_how_they_scatter(blocks, trusted):
    found, of = shown_in(blocks, trusted, np.random.default_rng(21))
    times = np.sqrt(interval_inflation(found, of, (0,)) / inflation(found, of, (0,)))
    assert times == pytest.approx(stats.t.ppf(0.975, blocks + trusted - 1.0) / 1.96, rel=1e-6)
    # Of what no block tells apart from the others nothing is known of how they scatter.
    none = channel(trusted, block=np.zeros(N, dtype=int), block_lengths=(1,))
    assert interval_inflation(found, none, (0,)) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize(
    ("told", "scatter", "freedom"),
    # Blocks that scatter by turns: nine as one hardly. Less than the noise model says: as many as the shortest ones.
    [(1.0, 3.0, 59.0), (1.0, 0.1, 59.0), (0.0447, 3.0, 1.0)],
)
def test_an_interval_is_known_by_the_blocks_that_scatter_most_and_no_worse_than_by_two(told, scatter, freedom):
    x = np.where(BLOCK == 0, 1.0, told)[:, None]
    found = linear_fit(x, scatter * np.where(BLOCK % 2 == 0, 1.0, -1.0))
    of = channel(0.0, block_lengths=(1, 9) if told == 1.0 else (1,))
    times = np.sqrt(interval_inflation(found, of, (0,)) / inflation(found, of, (0,)))
    assert times == pytest.approx(stats.t.ppf(0.975, freedom) / 1.96, rel=1e-6)


@thinned("blocks", [3, 6, 20], quick=1)
def test_of_few_blocks_too_intervals_hold_nearly_as_often_as_they_say(blocks):
    rng, held = np.random.default_rng(22), []
    for _ in range(300):
        found, of = shown_in(blocks, 1.0, rng)
        deviation = np.sqrt(found.covariance()[0, 0] * interval_inflation(found, of, (0,)))
        held.append(abs(found.vector[0]) < 1.96 * deviation)
    # Of 1.96 deviations without that 73, 83 and 92 %.
    assert 0.86 < np.mean(held) < 0.99


def longest(lengths, fewest=5, blocks=N // EACH):
    """The inflation by blocks of these lengths, of noise that wanders, of what the first so many blocks show."""
    x = np.where(np.arange(N) < blocks * EACH, 1.0, 0.0)[:, None]
    found = linear_fit(x, wandering(np.random.default_rng(17)))
    return inflation(found, channel(0.0, block_lengths=lengths, fewest_blocks=fewest), (0,))


def test_blocks_are_judged_where_there_are_enough_of_them_and_more_than_one_speaks_whatever_other_lengths_show():
    assert longest((1,), fewest=60) > 5.0
    assert longest((1,), fewest=61) == 1.0
    # Nine are taken as one in seven.
    assert longest((9, 1), fewest=8) == longest((1,), fewest=8)
    assert longest((1,), blocks=1) == 1.0
    assert longest((3, 1), blocks=2) == longest((1,), blocks=2) > 5.0


def test_what_repeats_is_what_is_left_without_the_block_that_says_most_however_little_that_is():
    x = np.random.default_rng(11).standard_normal((N, 1))
    y = 0.01 * (0.5 * x[:, 0] + np.random.default_rng(12).standard_normal(N))
    small, big = linear_fit(EMPTY, y), linear_fit(x, y)
    blocks = held_out_by_block(small, channel()) - held_out_by_block(big, channel())
    assert 0.0 < blocks.max() < 0.1
    proof = compare(small, big, channel(), 1.0)
    assert proof.held_out_without_best == pytest.approx(blocks.sum() - blocks.max(), rel=1e-9)
    others = np.sort(blocks)[:-2]
    assert proof.held_out_without_two_best == pytest.approx(others.sum(), rel=1e-9)
    assert others.sum() > others.max()
    # A log of a single residual pays for a parameter as one of two.
    assert compare(small, big, channel(count=1), 1.0).score == pytest.approx(
        2.0 * proof.gain / proof.inflation - np.log(2.0)
    )
    assert proof.score_without_best(1.0, 1) == pytest.approx(
        2.0 * proof.held_out_without_best / proof.inflation - np.log(2.0)
    )


def test_where_every_block_is_fitted_worse_none_is_left_out_of_what_repeats():
    y = np.random.default_rng(16).standard_normal(N)
    small, big = (Fit(np.zeros(0), (), 0.0, times * y, EMPTY) for times in (1.0, 1.001))
    proof = compare(small, big, channel(), 1.0)
    assert proof.held_out_without_best < 0.0
    assert proof.held_out_without_best == proof.held_out
    assert proof.held_out_without_two_best == 0.0


def test_what_shows_in_three_blocks_does_so_however_much_worse_others_are_fitted():
    y = np.random.default_rng(16).standard_normal(N)

    def proof(better):
        times = np.where(np.isin(BLOCK, better), 0.5, 1.1)
        small, big = (Fit(np.zeros(0), (), 0.0, each * y, EMPTY) for each in (1.0, times))
        return compare(small, big, channel(), 1.0)

    gains = np.sort(0.5 * (1.0 - 0.25) * np.bincount(BLOCK, weights=y**2)[[3, 5, 9]])
    three = proof([3, 5, 9])
    assert three.held_out_without_best < 0.0
    assert three.held_out_without_two_best == pytest.approx(gains[0])
    # Of one alone that is left out, and no other.
    one, two = proof([3]), proof([3, 5])
    assert one.held_out_without_two_best == two.held_out_without_two_best == 0.0
    assert one.held_out_without_best == pytest.approx(one.held_out - 0.375 * (y[BLOCK == 3] ** 2).sum())


def test_what_repeats_is_there_without_a_block_and_in_a_third_place_says_more_than_a_parameter_costs():
    price = 0.5 * np.log(1000.0)
    for best, two_best, shows in (
        (0.1, 1.001 * price, True), (0.1, price, False), (70.0, -1.0, False), (0.0, 9.0, False), (-1.0, 9.0, False),
    ):  # fmt: skip
        assert EffectEvidence(90.0, 80.0, best, two_best, 9.0, 99.0).holds_without_two_best(1000) == shows
    # A log of a single residual counts as one of two.
    assert not EffectEvidence(90.0, 80.0, 70.0, 0.34, 9.0, 99.0).holds_without_two_best(1)
    assert EffectEvidence(90.0, 80.0, 70.0, 0.35, 9.0, 99.0).holds_without_two_best(1)


def test_evidence_is_divided_by_the_scatter_of_what_is_added_and_of_nothing_else():
    rng = np.random.default_rng(15)
    x = np.column_stack([np.ones(N), rng.standard_normal(N)])
    y = wandering(rng) + rng.standard_normal(N)
    small, big = linear_fit(x[:, :1], y), linear_fit(x, y)
    own, all_of_it = inflation(big, channel(), (1,)), inflation(big, channel(), (0, 1))
    assert all_of_it > 3.0 * own
    assert compare(small, big, channel(), 1.0).inflation == own
