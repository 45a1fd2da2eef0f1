"""Posterior predictive check: is the log one that the model can make with the parameters that were inferred?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.checks import CHECKS, Scores, ScoreTest
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import Excitation
from disco_hw.inference.noise import Noise
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds
from disco_hw.inference.workers import Workers

Array = NDArray[np.float64]

# On logs of robots without any difference the largest of all values stays below this (tools/infer_study.py).
LARGEST_DEVIATION = 5.0
_EDGE_DEVIATIONS = 1.5
_OUTSIDE_SHARE = 0.01
_EDGE_WIDTH = 0.1


@dataclass(frozen=True)
class Predictive:
    """`deviations` (13,): how far the log's value of each of `CHECKS` is from the simulated ones, in their standard
    deviations; `estimate_deviations` (3,) the same for the estimates of wheel radius, x_icr and kappa. `edge` names
    parameters whose posterior is pressed against the prior's edge.
    """

    deviations: Array
    estimate_deviations: Array
    edge: tuple[str, ...]

    @property
    def outside_simulated(self) -> bool:
        """Whether the log is unlike every simulation under the posterior."""
        largest = max(np.abs(self.deviations).max(), np.abs(self.estimate_deviations).max())
        return bool(largest > LARGEST_DEVIATION) or bool(self.edge)

    @property
    def disagreements(self) -> list[tuple[ScoreTest, float]]:
        """The checks that disagree, the worst first, with their deviations."""
        order = np.argsort(-np.abs(self.deviations))
        return [(CHECKS[i], float(self.deviations[i])) for i in order if abs(self.deviations[i]) > LARGEST_DEVIATION]


def predictive(
    drive: Excitation,
    noise: Noise,
    simulator: Simulator,
    draws: Array,
    low: Array,
    high: Array,
    seed: int,
    workers: Workers | None = None,
    done: Callable[[int], None] = lambda _: None,
) -> Predictive:
    """Compare a log with simulations at posterior `draws` (n, 3), one each; `low`, `high` (3,) bound the prior.

    `workers` and `done` as for `Simulator.summaries`.
    """
    weights = estimates(drive, noise)
    scores = Scores(drive, weights)
    seeds = draw_seeds(draws.shape[0], np.random.default_rng(seed))

    def both(poses: Array) -> Array:
        return np.column_stack([np.array([scores(one) for one in poses]), weights.raw(poses)])

    simulated, fits = np.split(simulator.summaries(draws, seeds, both, workers, done), [len(CHECKS)], axis=1)
    deviations = _deviations(scores(drive.pose), simulated)
    fit_deviations = _deviations(weights.raw(drive.pose[None])[0], fits)
    return Predictive(deviations, fit_deviations, edge_parameters(draws, low, high, weights.theta(drive.pose[None])[0]))


def edge_parameters(draws: Array, low: Array, high: Array, estimate: Array) -> tuple[str, ...]:
    """Parameters determined well (sd below a tenth of the range) that the prior cuts off.

    Their mean is within 1.5 sd of an edge (the half of a Gaussian that an edge leaves has its mean 1.3 of its own sd
    away from it), or the plain `estimate` (3,) is outside by a hundredth of the range.
    """
    span = high - low
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    pressed = np.minimum(mean - low, high - mean) < _EDGE_DEVIATIONS * sd
    pressed |= np.minimum(estimate - low, high - estimate) < -_OUTSIDE_SHARE * span
    pressed &= sd < _EDGE_WIDTH * span
    return tuple(name for name, flag in zip(NAMES, pressed.tolist(), strict=True) if flag)


def _deviations(observed: Array, simulated: Array) -> Array:
    spread = simulated.std(axis=0)
    seen = spread > 1e-12
    return np.asarray(np.where(seen, (observed - simulated.mean(axis=0)) / np.where(seen, spread, 1.0), 0.0))
