import numpy as np
import pytest

from disco_hw.errors import InputError
from disco_hw.inference.density_network import NetworkSettings, train
from disco_hw.inference.estimates import CROSS_CORRELATION, PAPER_STATISTICS, CrossCorrelation, PaperStatistics
from disco_hw.inference.infer import InferOptions, infer
from tests.inference.drives import logged, robot_config


def test_they_are_the_means_of_position_and_of_its_steps_in_time_but_for_the_jump_between_two_runs():
    poses = np.zeros((2, 5, 3))
    poses[0, :, 0] = [0.0, 1.0, 3.0, 6.0, 10.0]
    poses[1, :, 1] = [5.0, 5.0, 5.0, 5.0, 1.0]
    found = PaperStatistics(np.array([True, False, False, False, False]))(poses)
    assert found.shape == (2, len(PAPER_STATISTICS))
    assert found[0] == pytest.approx([4.0, 0.0, 2.5, 0.0])
    assert found[1] == pytest.approx([0.0, 4.2, 0.0, -1.0])
    poses[0, 2:, 0] += 100.0
    in_two_runs = PaperStatistics(np.array([True, False, True, False, False]))(poses)
    assert in_two_runs[0, 2] == pytest.approx((1.0 + 3.0 + 4.0) / 3)


def test_moving_the_whole_path_does_not_change_the_steps():
    poses = np.random.default_rng(0).standard_normal((1, 20, 3))
    statistics = PaperStatistics(np.arange(20) == 0)
    assert statistics(poses + 7.0)[0, 2:] == pytest.approx(statistics(poses)[0, 2:])


def test_steps_are_correlated_with_what_either_wheel_rolled():
    # Three steps, of which the second leads from one run to the next.
    starts = np.array([True, False, True, False])
    poses = np.zeros((1, 4, 3))
    poses[0, :, 0] = [0.0, 2.0, 50.0, 53.0]
    poses[0, :, 2] = [0.0, 0.5, 9.0, 8.9]
    roll = np.array([[9.0, 9.0], [1.0, 0.4], [9.0, 9.0], [2.0, -0.2]])
    found = dict(zip(CROSS_CORRELATION, CrossCorrelation(starts, roll)(poses)[0], strict=True))
    # The wheels roll 0.8 and 1.2, then 2.1 and 1.9.
    assert found["<dx, left>"] == pytest.approx((2.0 * 0.8 + 3.0 * 2.1) / 2)
    assert found["<dx, right>"] == pytest.approx((2.0 * 1.2 + 3.0 * 1.9) / 2)
    assert found["<dyaw, right>"] == pytest.approx((0.5 * 1.2 - 0.1 * 1.9) / 2)
    assert found["<dy, left>"] == 0.0
    assert found["mean dx"] == pytest.approx(2.5)
    assert found["variance of dx"] == pytest.approx(0.25)


@pytest.mark.thorough
def test_random_features_learn_a_density_that_no_line_fits_and_are_not_trained():
    rng = np.random.default_rng(1)
    statistics = rng.uniform(-2.0, 2.0, (1500, 1))
    targets = np.sin(1.5 * statistics) ** 2 + 0.1 * rng.standard_normal((1500, 1))
    settings = NetworkSettings(members=1, components=1, fourier=60)
    network = train(statistics[:1200], targets[:1200], settings, seed=1)
    score = network.mixtures(statistics[1200:]).log_density(targets[1200:, None])[:, 0].mean()
    of_a_line = -0.5 * np.log(2.0 * np.pi * np.e * targets.var())
    assert score > of_a_line + 0.6
    trained = dict(network.stack.named_parameters())
    assert "last" in trained
    assert not {"first", "frequencies", "phases"} & set(trained)


@pytest.mark.parametrize("option", ["random_features", "cross_correlation"])
def test_what_is_the_papers_is_refused_without_it(option):
    with pytest.raises(InputError, match="give --paper too"):
        infer(None, None, InferOptions(**{option: True}))


@pytest.mark.thorough
def test_what_is_asked_for_is_what_learns():
    options = InferOptions(paper=True, simulations=200, random_features=True, cross_correlation=True)
    found = infer(logged("poor"), robot_config(), options)
    assert found.observed.size == len(CROSS_CORRELATION)
    assert found.fitted.statistics.shape[1] == len(CROSS_CORRELATION)
    assert "frequencies" in dict(found.fitted.network.stack.named_buffers())
