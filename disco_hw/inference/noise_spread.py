"""How well a log tells its own noise: measured again on simulations of the same drive.

A minute of circling holds some twenty stretches of the length that slip shows itself over, so slip is measured to 10 to
25 %, and a little too small, because the geometry is fitted to the same poses. A posterior that takes it for known is
too narrow as often as it comes out small.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.estimates import estimates
from disco_hw.inference.noise import Noise, measured_noise
from disco_hw.inference.simulate import Simulator, draw_seeds

Array = NDArray[np.float64]

_REPEATS = 48
# What vanishes in a simulation counts as a third, what explodes as three times.
_LARGEST_RATIO = 3.0
_SMALLEST_VARIANCE = 1e-8


@dataclass(frozen=True, slots=True)
class NoiseSpread:
    """Noise without the bias of its measurement, and `factor` (5, 5), lower triangular, of the covariance of its
    logarithms in the order of `Noise.vector`; `fit_std` (3,) is the scatter of the plain estimates of the parameters.
    """

    noise: Noise
    factor: Array
    fit_std: Array


def noise_spread(simulator: Simulator, theta: Array, seed: int, repeats: int = _REPEATS) -> NoiseSpread:
    """Measure the noise of `repeats` simulations at `theta` (3,), which all have the simulator's own.

    The logarithm of what is measured scatters about that of the truth as it does here (parametric bootstrap).
    """
    drive, noise = simulator.drive, simulator.noise
    poses = simulator.poses(np.tile(theta, (repeats, 1)), draw_seeds(repeats, np.random.default_rng(seed)))
    fits = estimates(drive, noise).theta(poses)
    found = [measured_noise(replace(drive, pose=pose), fit) for pose, fit in zip(poses, fits, strict=True)]
    ratio = np.array([one.vector() for one in found]) / noise.vector()
    log_ratio = np.log(np.clip(ratio, 1.0 / _LARGEST_RATIO, _LARGEST_RATIO))
    covariance = np.cov(log_ratio.T) + _SMALLEST_VARIANCE * np.eye(log_ratio.shape[1])
    mean = noise.vector() * np.exp(-log_ratio.mean(axis=0))
    return NoiseSpread(Noise(*mean.tolist()), np.asarray(np.linalg.cholesky(covariance)), fits.std(axis=0))
