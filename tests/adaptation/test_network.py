from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from disco_hw.adaptation.network import Training, train_network, training_range
from disco_hw.adaptation.recursive import evidence
from disco_hw.inference.excitation import USUAL, Noise
from disco_hw.inference.simulate import Simulator, draw_seeds
from disco_hw.model import Model
from tools.adaptation_drives import TRUTH, excited


@cache
def network(drives=90, of_each=8):
    """Trained on a quarter of what the adapter trains it on, which leaves it a little wider."""
    low, high = training_range(np.array(TRUTH), np.array([0.0, 0.005, 0.1]), np.array([0.5, 0.5, 0.5]))
    training = Training(low, high, 8.0, drives=drives, of_each=of_each)
    return train_network(training, USUAL, Model(0.061, 0.415, 0.238))


def test_ranges_lie_within_the_prior():
    low, high = training_range(np.array(TRUTH), np.array([0.0, 0.005, 0.1]), np.array([0.5, 0.5, 0.5]))
    assert (low >= [0.0, 0.005, 0.1]).all()
    assert (high <= [0.5, 0.5, 0.5]).all()
    assert ((low < TRUTH) & (high > TRUTH)).all()


@pytest.mark.parametrize("size", [(90, 8), pytest.param((240, 12), marks=pytest.mark.long, id="as the adapter")])
def test_posteriors_cover_the_truth_on_drives_of_a_simulator_that_is_not_its_own(size):
    """90 % intervals of 40 drives with 3 parameters hold 80 to 98 %."""
    rng = np.random.default_rng(1)
    inside = []
    for seed in range(40):
        truth = tuple(np.array(TRUTH) * rng.uniform(0.85, 1.1, 3))
        found = network(*size).condition(evidence(excited(8.0, seed=seed, truth=truth), USUAL))
        assert not found.doubt
        inside.append(np.abs(found.mean - truth) < 1.645 * np.sqrt(np.diag(found.covariance)))
    assert 0.80 < np.mean(inside) < 0.98


@cache
def slipping(scale):
    """Shares inside 90 % intervals and mean widening over 100 drives with the usual sensor, and slip `scale` times."""
    slip = Noise(*(USUAL.vector() * np.array([1.0, 1.0, scale, scale, scale])).tolist())
    rng = np.random.default_rng(4)
    inside, widening = [], []
    drives = [excited(12.0, seed=seed) for seed in range(20)]
    for drive in drives * 5:
        truth = np.array(TRUTH) * rng.uniform(0.85, 1.1, 3)
        poses = Simulator(Model(0.061, 0.415, 0.238), drive, slip).poses(truth[None], draw_seeds(1, rng))[0]
        found = network().condition(evidence(replace(drive, pose=poses), USUAL))
        inside.append(np.abs(found.mean - truth) < 1.645 * np.sqrt(np.diag(found.covariance)))
        widening.append(found.widening)
    return float(np.mean(inside)), float(np.mean(widening))


@pytest.mark.parametrize("scale", [1.0, 1.5])
def test_posteriors_cover_the_truth_though_slip_is_more_than_it_was_taken_to_be(scale):
    inside, _ = slipping(scale)
    assert 0.80 < inside < 0.98


def test_how_much_the_robot_slips_is_told_from_the_window():
    quiet, usual, slippery = (slipping(scale)[1] for scale in (0.7, 1.0, 1.5))
    assert quiet < 1.0 < usual
    assert quiet < 0.9 * usual
    assert slippery > 1.15 * usual


def test_driving_that_fits_no_geometry_is_doubted():
    drive = excited(10.0)
    poses = drive.pose.copy()
    poses[:, 0] += np.where(np.arange(poses.shape[0]) % 5 == 0, 0.2, 0.0)
    drive.pose[:] = poses
    assert "fits no geometry" in network().condition(evidence(drive, USUAL)).doubt
