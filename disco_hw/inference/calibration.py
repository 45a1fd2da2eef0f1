"""Whether the posterior's widths can be trusted: simulation-based calibration, coverage, effective simulations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import kstest

from disco_hw.inference.rounds import Fitted, Simulate
from disco_hw.inference.simulate import draw_seeds

Array = NDArray[np.float64]

LEVELS = (0.5, 0.8, 0.9, 0.95)
_DRAWS = 200


@dataclass(frozen=True)
class Calibration:
    """From fresh simulations at parameters drawn from the last region.

    `ranks` (n, 3) in [0, 1] of the true parameters among posterior draws, uniform if calibrated, and `p_values` (3,) of
    the Kolmogorov-Smirnov test for that; `coverage` (levels,) of the joint highest-density regions of `LEVELS`.
    """

    ranks: Array
    p_values: Array
    coverage: Array


def calibrate(fitted: Fitted, simulate: Simulate, count: int, seed: int) -> Calibration:
    """Simulation-based calibration (Talts et al., 2018) and expected coverage, on `count` fresh simulations."""
    rng = np.random.default_rng(seed)
    truth = fitted.region.draw(count, rng)
    statistics = simulate(truth, draw_seeds(count, rng))
    draws, _ = fitted.draw(statistics, _DRAWS, rng)
    # A rank between two draws is anywhere between them.
    ranks = ((draws < truth[:, None]).sum(axis=1) + rng.random(truth.shape)) / (_DRAWS + 1.0)
    mixtures = fitted.network.mixtures(statistics)
    size = truth.shape[1]
    unit = fitted.region.unit(draws.reshape(-1, size)).reshape(draws.shape)
    density = mixtures.log_density(unit)
    at_truth = mixtures.log_density(fitted.region.unit(truth)[:, None])[:, 0]
    mass = (density > at_truth[:, None]).mean(axis=1)
    return Calibration(
        ranks,
        np.array([float(kstest(column, "uniform").pvalue) for column in ranks.T]),
        np.array([float((mass <= level).mean()) for level in LEVELS]),
    )


def effective_simulations(fitted: Fitted, observed: Array) -> float:
    """How many simulations of the last region the posterior rests on: (sum w)^2 / sum w^2 with w its density there."""
    mixtures = fitted.network.mixtures(observed[None])
    log_weight = mixtures.log_density(fitted.region.unit(fitted.theta)[None])[0]
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum())
