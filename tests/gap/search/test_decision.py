"""The simplest model that predicts as well as the best, in units of the sensors' noise."""

import math

import numpy as np
import pytest

from disco_hw.gap import offered_stage
from disco_hw.gap.search.decision import best_of, chance, first_as_good, is_as_good, score
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import errors_in_stretches, errors_of_size


def in_stretches(position_m, yaw_rad=None):
    """Errors of so much in each stretch of time, in heading as much as in position where nothing else is said."""
    return errors_in_stretches(np.square(position_m), np.square(position_m if yaw_rad is None else yaw_rad))


def test_a_stretch_scores_the_log_of_its_errors_and_the_noise_in_position_and_heading():
    errors, floor = in_stretches([3.0, 1.0], [2.0, 1.0]), in_stretches([4.0, 1.0], [1.0, 1.0])
    assert score(errors, floor) == pytest.approx([0.5 * np.log(25.0 * 5.0), 0.5 * np.log(2.0 * 2.0)])
    assert score(errors, None) == pytest.approx([np.log(3.0 * 2.0), 0.0])
    # Sums over a whole log count as one stretch.
    assert score(errors_of_size(3.0, 2.0), None) == pytest.approx([np.log(6.0)])
    assert np.isfinite(score(in_stretches([0.0]), None)).all()


def test_a_millimetre_counts_by_what_the_noise_is():
    best, other = in_stretches([1e-3] * 4), in_stretches([2e-3] * 4)
    quiet, loud = in_stretches([0.4e-3] * 4), in_stretches([20e-3] * 4)
    assert (score(other, quiet) - score(best, quiet)).mean() == pytest.approx(np.log((4.0 + 0.16) / (1.0 + 0.16)))
    assert (score(other, loud) - score(best, loud)).mean() < 0.01


@pytest.mark.parametrize(
    ("worse_by", "of_choices"),
    [
        # All of one sign: one choice of signs of sixteen.
        ([0.3, 0.1, 0.3, 0.1], 1 / 16),
        # As large: with either sign of the last one.
        ([0.3, 0.1, 0.3, 0.0], 2 / 16),
        # As large or larger: as it is, with the last one turned, and with the first two or three of the same.
        ([0.3, 0.1, 0.3, -0.1], 3 / 16),
        # Two stretches that show it are enough where no other one is against it.
        ([0.0, 0.01, 0.02, 0.01, 2.7, 2.0, 0.01, 0.01], 2 / 256),
        # One against it takes a half of these.
        ([1.0, -1.0], 3 / 4),
        # Of a single stretch either sign is as likely.
        ([1.0], 1 / 2),
    ],
)
def test_chance_is_the_share_of_signs_that_give_as_large_an_excess(worse_by, of_choices):
    assert chance(in_stretches([1.0] * len(worse_by)), in_stretches(np.exp(worse_by)), None) == pytest.approx(
        of_choices
    )


def test_of_many_stretches_a_sample_of_signs_is_taken_that_is_always_the_same():
    worse = np.random.default_rng(3).normal(0.1, 0.5, 40)
    first, second = (chance(in_stretches([1.0] * 40), in_stretches(np.exp(worse)), None) for _ in range(2))
    assert first == second
    # The mean of many signs is normal.
    z = worse.sum() / np.sqrt((worse**2).sum())
    assert first == pytest.approx(0.5 * math.erfc(z / np.sqrt(2.0)), abs=0.02)


def test_of_models_that_are_equally_good_one_in_ten_is_taken_for_worse():
    generator = np.random.default_rng(7)
    # Few stretches say much, and most say nothing: of such errors no standard deviation is a measure.
    drives = generator.normal(0.0, 0.5, (400, 8)) ** 3
    worse = [not is_as_good(in_stretches([1.0] * 8), in_stretches(np.exp(drive)), None) for drive in drives]
    assert np.mean(worse) == pytest.approx(0.1, abs=0.045)


@pytest.mark.parametrize(
    ("worse_by", "as_good"),
    [
        ([0.0, 0.0, 0.0, 0.0], True),
        ([-0.1, -0.2, -0.1, -0.1], True),
        ([0.1, 0.1, 0.1, 0.1], False),
        ([0.3, 0.1, 0.3, -0.05], True),
        # Three of three are the most that three can say.
        ([0.3, 0.3, 0.3], False),
        ([0.3, 0.3, -0.1], True),
        ([0.3], False),
    ],
)
def test_as_good_is_what_may_be_worse_by_chance(worse_by, as_good):
    best, other = in_stretches([1.0] * len(worse_by)), in_stretches(np.exp(worse_by))
    assert is_as_good(best, other, None) is as_good


def test_as_good_is_what_is_worse_by_less_than_is_worth_a_change_in_position_and_heading_together():
    best, other = in_stretches([1.0] * 4), in_stretches(np.exp([0.04] * 4))
    # Position and heading, a hundredth of e each four times.
    assert not is_as_good(best, other, None, worth=0.079)
    assert is_as_good(best, other, None, worth=0.081)
    # One pays for the other.
    assert not is_as_good(best, in_stretches([0.5] * 4, [2.2] * 4), None)
    assert is_as_good(best, in_stretches([0.5] * 4, [2.0] * 4), None)


def test_the_simplest_that_is_as_good_is_chosen_and_the_first_of_equals_is_the_best():
    errors = {"plain": [2.0, 2.1, 2.0], "some": [1.1, 0.95, 1.05], "all": [1.0, 1.0, 1.0], "again": [1.0, 1.0, 1.0]}
    errors = {name: in_stretches(sizes) for name, sizes in errors.items()}
    assert first_as_good(("plain", "some", "all"), errors.__getitem__, None) == "some"
    assert first_as_good(("plain", "all", "some"), errors.__getitem__, None) == "all"
    assert best_of(("again", "all"), errors.__getitem__, None) == "again"
    # As far below the noise as all these are, the plainest does.
    assert first_as_good(("plain", "some", "all"), errors.__getitem__, in_stretches([1e9] * 3)) == "plain"


def offered(timed, amended, adds=True, noise=0.1, refitted=None):
    """The stage that is handed out of errors by stretch, `refitted` far off where nothing is said of it."""
    far_off = [9.0] * len(timed)
    stages = {"refitted": refitted or far_off, "timed": timed, "amended": amended, "floor": [noise] * len(timed)}
    return offered_stage({s: {2.0: in_stretches(of)} for s, of in stages.items()}, adds, DEFAULT_SETTINGS)


@pytest.mark.parametrize(
    ("amended", "stage"),
    [
        ([0.5, 0.6, 0.5, 0.6], "amended"),
        ([1.0, 1.0, 1.0, 1.0], "timed"),
        ([1.2, 1.3, 1.2, 1.1], "timed"),
        # Better by far, in one stretch alone: the others are worse.
        ([0.1, 1.3, 1.3, 1.3], "timed"),
        ([0.9, 0.91, 0.9, 0.91], "amended"),
        ([0.8, 1.2, 0.8, 1.15], "timed"),
    ],
)
def test_an_amended_model_is_handed_out_where_it_is_clearly_better_than_a_delay_and_a_lag(amended, stage):
    assert offered([1.0] * 4, amended) == stage


def test_the_model_that_is_handed_out_is_the_simplest_that_nothing_clearly_beats():
    level = [1.0, 1.0, 1.0]
    assert offered(level, level, adds=False) == "amended"
    assert offered(level, level, adds=True) == "timed"
    # Where nothing is missing the geometry is fitted, unless a delay and a lag are clearly better.
    assert offered([0.5] * 3, level, adds=False) == "timed"
    # The geometry alone, where it is clearly better than with a delay and a lag.
    assert offered([3.0] * 4, [2.0] * 4, refitted=[1.0] * 4) == "refitted"
    assert offered([1.0, 0.99, 1.0, 1.0], [0.9, 1.05, 1.0, 1.0], refitted=[1.0, 1.1, 1.0, 0.9]) == "timed"
    # Errors below the noise do not choose.
    assert offered([0.01] * 3, [0.005] * 3, noise=0.0001) == "amended"
    assert offered([0.01] * 3, [0.005, 0.02, 0.005], noise=0.5) == "timed"
