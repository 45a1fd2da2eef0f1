"""The simplest model that predicts as well as the best, in units of the sensors' noise."""

import numpy as np
import pytest

from disco_hw.gap import offered_stage
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.search.decision import best_of, excess, first_as_good, is_as_good, score
from disco_hw.gap.settings import DEFAULT_SETTINGS


def in_stretches(position_m, yaw_rad=None, folds=2):
    """Errors of so much in each stretch of time, in heading as much as in position where nothing else is said."""
    both = np.column_stack([position_m, position_m if yaw_rad is None else yaw_rad]).astype(float)
    size = np.sqrt((both**2).mean(axis=0))
    return PredictionErrors(size[0], (0.0, 1.0), size[1], (0.0, 1.0), 0.0, {}, both**2, folds)


def test_a_stretch_scores_the_log_of_its_errors_and_the_noise_in_position_and_heading():
    errors, floor = in_stretches([3.0, 1.0], [2.0, 1.0]), in_stretches([4.0, 1.0], [1.0, 1.0])
    assert score(errors, floor) == pytest.approx([0.5 * np.log(25.0 * 5.0), 0.5 * np.log(2.0 * 2.0)])
    assert score(errors, None) == pytest.approx([np.log(3.0 * 2.0), 0.0])
    # Sums over a whole log count as one stretch.
    whole = PredictionErrors(3.0, (0.0, 1.0), 2.0, (0.0, 1.0), 0.0, {})
    assert score(whole, None) == pytest.approx([np.log(6.0)])
    assert np.isfinite(score(in_stretches([0.0]), None)).all()


def test_a_millimetre_counts_by_what_the_noise_is():
    best, other = in_stretches([1e-3] * 4), in_stretches([2e-3] * 4)
    quiet, loud = in_stretches([0.4e-3] * 4), in_stretches([20e-3] * 4)
    assert excess(best, other, quiet)[0] == pytest.approx(np.log((4.0 + 0.16) / (1.0 + 0.16)))
    assert excess(best, other, loud)[0] < 0.01


@pytest.mark.parametrize(("folds", "share"), [(2, 2.0 / 4.0 + 1.0), (4, 2.0 / 4.0 + 1.0 / 3.0)])
def test_the_standard_error_is_that_of_another_drive_by_how_the_excess_scatters_over_stretches(folds, share):
    best, other = in_stretches([1.0] * 4, folds=folds), in_stretches(np.exp([0.3, 0.1, 0.3, 0.1]))
    mean, error = excess(best, other, None)
    assert mean == pytest.approx(0.4)
    # Of four stretches Student's t is 1.197 where a normal distribution has one standard deviation.
    assert error == pytest.approx(1.1969 * 0.2 * np.sqrt(4.0 / 3.0 * share), rel=1e-3)
    # Of one stretch nothing is known of it.
    assert excess(in_stretches([1.0]), in_stretches([np.e]), None) == (pytest.approx(2.0), 0.0)


def test_stretches_of_a_single_fold_count_as_those_of_one_of_two():
    one, two = (excess(in_stretches([1.0, 2.0], folds=folds), in_stretches([3.0, 2.5]), None) for folds in (1, 2))
    assert one == two


def test_one_drive_in_six_lies_beyond_a_standard_error_of_what_another_says():
    # Stretches differ by chance alone; models share what they learn from, so that a drive moves them all.
    chance, stretches, folds = np.random.default_rng(7), 12, 4
    beyond = []
    for _ in range(4000):
        one, other = (chance.normal(0.5, 0.3, stretches) for _ in range(2))
        learnt = chance.normal(0.0, 0.3 / np.sqrt(folds - 1))
        mean, error = excess(in_stretches([1.0] * stretches, folds=folds), in_stretches(np.exp(one / 2.0)), None)
        beyond.append(other.mean() + learnt < mean - error)
    assert np.mean(beyond) == pytest.approx(1.0 - 0.8413, abs=0.02)


@pytest.mark.parametrize(
    ("worse_by", "as_good"),
    # Of two stretches one standard error is 1.8 of what they scatter by, with Student's t 1.837, times the root of 2.
    [([0.0, 0.0], True), ([-0.1, -0.2], True), ([0.11, 0.11], False), ([0.34, 0.1], True), ([0.34, 0.27], False)],
)
def test_as_good_is_what_is_worse_by_no_more_than_one_standard_error(worse_by, as_good):
    assert is_as_good(in_stretches([1.0, 1.0]), in_stretches(np.exp(worse_by)), None) is as_good


def test_position_and_heading_pay_for_each_other():
    best, other = in_stretches([1.0] * 4), in_stretches([0.5] * 4, [2.2] * 4)
    assert not is_as_good(best, other, None)
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
    return offered_stage({s: {2.0: in_stretches(of, folds=4)} for s, of in stages.items()}, adds, DEFAULT_SETTINGS)


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


def test_a_model_that_adds_nothing_to_a_delay_and_a_lag_is_simpler_than_that():
    level = [1.0, 1.0, 1.0]
    assert offered(level, level, adds=False) == "amended"
    assert offered(level, level, adds=True) == "timed"
    # Where nothing is missing the geometry is fitted, unless a delay and a lag are clearly better.
    assert offered([0.5] * 3, level, adds=False) == "timed"


def test_the_geometry_alone_is_handed_out_where_it_is_clearly_better_than_with_a_delay_and_a_lag():
    assert offered([3.0] * 4, [2.0] * 4, refitted=[1.0] * 4) == "refitted"
    assert offered([1.0, 0.99, 1.0, 1.0], [0.9, 1.05, 1.0, 1.0], refitted=[1.0, 1.1, 1.0, 0.9]) == "timed"


def test_errors_below_the_noise_do_not_choose():
    assert offered([0.01] * 3, [0.005] * 3, noise=0.0001) == "amended"
    assert offered([0.01] * 3, [0.005, 0.02, 0.005], noise=0.5) == "timed"
