"""What a log says of its own noise is only so sure, and the simulations must not pretend otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import noise_spread
from disco_hw.inference.noise import Noise, measured_noise
from disco_hw.inference.simulate import Simulator, draw_seeds
from disco_hw.model import Model
from tests.inference.drives import THETA, logged

TRUE = Noise(0.006, 0.006, 0.008, 0.005, 0.02)
MODEL = Model(0.06, 0.4)


@pytest.fixture(scope="module")
def circle():
    return Simulator(MODEL, excitation(logged("circle")), TRUE)


def test_it_is_the_scatter_of_what_is_measured_on_other_drives_like_it(circle):
    seeds = draw_seeds(24, np.random.default_rng(9))
    poses = circle.poses(np.tile(THETA, (seeds.size, 1)), seeds)
    fits = estimates(circle.drive, TRUE).theta(poses)
    logs = [
        np.log(measured_noise(replace(circle.drive, pose=pose), fit).scales()[:5] / TRUE.scales()[:5])
        for pose, fit in zip(poses, fits, strict=True)
    ]
    known = noise_spread(circle, THETA, 1, repeats=24)
    predicted_std = np.sqrt(np.diag(known.factor @ known.factor.T))
    assert predicted_std[:5] == pytest.approx(np.std(logs, axis=0), rel=0.4)
    # The slip of one minute is told several times worse than the sensor's noise.
    assert predicted_std[2:5].min() > 2.0 * predicted_std[:2].max()
    assert np.log(known.noise.scales()[:5] / TRUE.scales()[:5]) == pytest.approx(-np.mean(logs, axis=0), abs=0.06)


def test_simulations_draw_their_noise_from_it(circle):
    factor = np.diag([1e-4, 1e-4, 0.5, 0.5, 0.5, 0.5, 1e-4])
    seeds = draw_seeds(200, np.random.default_rng(2))
    theta = np.tile(THETA, (seeds.size, 1))
    weights = estimates(circle.drive, TRUE)
    fixed, varied = (
        weights.theta(simulator.poses(theta, seeds)).std(axis=0)
        for simulator in (circle, replace(circle, noise_spread=factor))
    )
    # The mean square of exp(0.5 z) is exp(0.5).
    assert varied / fixed == pytest.approx(np.exp(0.25), rel=0.15)


def test_the_same_seed_tells_the_same(circle):
    first, second = (noise_spread(circle, THETA, 3, repeats=8) for _ in range(2))
    assert first.noise == second.noise
    assert np.array_equal(first.factor, second.factor)
