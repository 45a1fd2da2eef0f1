import numpy as np
import pytest

from disco_hw.inference.estimates import PAPER_STATISTICS, PaperStatistics


def test_they_are_the_means_of_position_and_of_its_steps_in_time():
    poses = np.zeros((2, 5, 3))
    poses[0, :, 0] = [0.0, 1.0, 3.0, 6.0, 10.0]
    poses[1, :, 1] = [5.0, 5.0, 5.0, 5.0, 1.0]
    found = PaperStatistics(np.array([True, False, False, False, False]))(poses)
    assert found.shape == (2, len(PAPER_STATISTICS))
    assert found[0] == pytest.approx([4.0, 0.0, 2.5, 0.0])
    assert found[1] == pytest.approx([0.0, 4.2, 0.0, -1.0])


def test_moving_the_whole_path_does_not_change_the_steps():
    poses = np.random.default_rng(0).standard_normal((1, 20, 3))
    statistics = PaperStatistics(np.arange(20) == 0)
    assert statistics(poses + 7.0)[0, 2:] == pytest.approx(statistics(poses)[0, 2:])


def test_the_jump_between_two_runs_does_not_count():
    poses = np.zeros((1, 4, 3))
    poses[0, 2:, 0] = 100.0
    found = PaperStatistics(np.array([True, False, True, False]))(poses)
    assert found[0, 2] == 0.0
