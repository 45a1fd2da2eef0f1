"""Errors on held-out stretches: the right model errs by the noise of a pose, a wrong one by what it lacks."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.noise import sensor_noise
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.channel_search import indices
from disco_hw.gap.search.cross_validation import (
    Chain,
    errors_of,
    floor_errors,
    fold_of,
    fold_vectors,
    scored_horizon_s,
    smoothed_poses,
    worse_by,
)
from disco_hw.gap.search.end_to_end import Ahead
from disco_hw.gap.search.least_squares import fit
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S, Folds
from tests.gap.synthetic import NOISE, body_channel, errors_in_stretches, vector_of

AHEAD_S = 2.0


def both(vector):
    return {fold: Chain(vector, None) for fold in (0, 1)}


def test_the_right_model_errs_by_the_noise_alone_and_a_wrong_one_by_more():
    channel, _ = body_channel(turn_slip=0.1)
    right = vector_of(turn_slip=0.1)
    poses = smoothed_poses(channel, right)
    sound = errors_of(channel, None, both(right), AHEAD_S, poses)
    wrong = errors_of(channel, None, both(channel.neutral), AHEAD_S, poses)
    floor = floor_errors(channel, sensor_noise(channel, channel.neutral), AHEAD_S, poses)
    # The pose at the end is a single measured one, that at the start a mean of many.
    assert sound.yaw_rad == pytest.approx(NOISE.yaw_rad, rel=0.25)
    assert sound.position_m == pytest.approx(floor.position_m, rel=0.2)
    assert wrong.yaw_rad > 5.0 * sound.yaw_rad
    assert wrong.position_ci[0] < wrong.position_m < wrong.position_ci[1]
    assert wrong.by_regime_m["turning on the spot"] > 2.0 * sound.by_regime_m["turning on the spot"]


def test_a_log_of_two_minutes_is_divided_into_long_stretches_and_a_shorter_one_finer():
    _, line = body_channel()
    for duration_s, folds in ((126.0, Folds(21.0, 2)), (125.9, Folds(9.0, 4))):
        assert replace(line, t_s=np.zeros(round(duration_s / GRID_STEP_S))).folds == folds


def test_every_third_stretch_is_of_one_fold_of_three():
    folds = Folds(2.0 * DEFAULT_SETTINGS.grid.block_s, 3)
    drive = SimpleNamespace(folds=folds, settings=DEFAULT_SETTINGS, log_begins_s=(0.0,))
    drive.stretch = partial(GriddedDrive.stretch, drive)
    channel = SimpleNamespace(drive=drive, settings=DEFAULT_SETTINGS, block=np.arange(14))
    assert fold_of(channel).tolist() == [0, 0, 1, 1, 2, 2] * 2 + [0, 0]


def test_what_a_fold_knows_nothing_about_is_not_in_its_prediction():
    channel, _ = body_channel(turn_slip=0.1)
    place = BODY.place["turn_slip.k_s"]
    found = fit(channel, vector_of(turn_slip=0.1), indices(channel, ("turn_slip",)))
    # As if all turning had been done in fold 0: nothing elsewhere depends on the slip.
    column, folds = found.active.index(place), channel.drive.folds.count
    elsewhere = fold_of(channel) != 0
    slope = found.jacobian.copy()
    slope[elsewhere, column] *= 1e-6
    vectors = fold_vectors(replace(found, slope=slope), fold_of(channel), folds, channel.neutral, DEFAULT_SETTINGS)
    assert vectors[0][place] == 0.0
    assert vectors[1][place] == pytest.approx(0.1, rel=0.2)


@pytest.mark.parametrize(("window_s", "judged_s"), [(None, 2.0), (2.0, 1.0), (1.2, 0.5)])
def test_stages_are_compared_as_far_ahead_as_runs_are_long(window_s, judged_s):
    channel, line = body_channel()
    if window_s is not None:
        first = np.arange(line.t_s.size) % round(window_s / GRID_STEP_S) == 0
        channel = BodyChannel.build(replace(line, first=first), NOISE, channel.neutral)
    poses = smoothed_poses(channel, channel.neutral)
    assert scored_horizon_s(channel, poses) == judged_s
    ahead = Ahead.of(channel, None, poses)
    assert [ahead_s for ahead_s, _ in ahead.starts] == ([1.0, 2.0] if window_s is None else [judged_s])
    assert np.isfinite(errors_of(channel, None, both(channel.neutral), judged_s, poses).position_m)


def test_the_larger_growth_of_position_and_heading_counts():
    before = errors_in_stretches([1.0] * 6, [4.0] * 6)
    assert worse_by(before, errors_in_stretches([4.0] * 6, [9.0] * 6)) == pytest.approx(2.0)
    assert worse_by(before, errors_in_stretches([1.0] * 6, [9.0] * 6)) == pytest.approx(1.5)
