"""Sequential inference: every round draws parameters only from where the last one left them possible.

Within a region draws are uniform, so the prior over the proposal is one constant there and the network's density is the
posterior as it stands: no division of mixtures, which fails for components wider than the proposal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.density_network import DensityNetwork, Mixtures, NetworkSettings, train
from disco_hw.inference.simulate import LocalWorkers, Seeds, Workers, draw_seeds

Array = NDArray[np.float64]
Simulate = Callable[[Array, Seeds], Array]
Say = Callable[[str], None]

SCOUT = NetworkSettings(members=2, epochs=60, patience=8)
FULL = NetworkSettings()

_DRAWS = 4000
_LARGEST_REJECTION = 30


@dataclass(frozen=True, slots=True)
class RoundSettings:
    """How simulations are shared out; `deviations` is the half width of the next round's region.

    The shares are of all simulations; with one share there is one round over the whole prior. `scout` is the network of
    all rounds but the last: it only has to find the region.
    """

    shares: tuple[float, ...] = (0.1, 0.1, 0.15, 0.15, 0.5)
    deviations: float = 4.5
    scout: NetworkSettings = SCOUT
    network: NetworkSettings = FULL


@dataclass(frozen=True)
class Fitted:
    """The last round: region, network in the region's coordinates, and the simulations it was trained on.

    `theta` (n, P), `statistics` (n, S); `simulations` counts those of all rounds.
    """

    region: Region
    network: DensityNetwork
    theta: Array
    statistics: Array
    simulations: int

    def draw(self, statistics: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
        """Draws (n, count, P) of the posteriors given statistics (n, S), and the share (n,) that had to be drawn again
        because it fell outside the region.
        """
        return truncated_draws(self.region, self.network.mixtures(statistics), count, rng)


def truncated_draws(region: Region, mixtures: Mixtures, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draws (n, count, P) of mixtures over a region's coordinates, inside it, and the share (n,) first outside."""
    n, _, size = mixtures.mean.shape
    drawn = np.empty((n, count, size))
    missing = np.ones((n, count), dtype=bool)
    outside = np.zeros(n)
    for attempt in range(_LARGEST_REJECTION):
        fresh = region.points(mixtures.draw(count, rng))
        good = region.contains(fresh.reshape(-1, size)).reshape(n, count)
        if attempt == 0:
            outside = 1.0 - good.mean(axis=1)
        take = missing & good
        drawn[take] = fresh[take]
        missing &= ~good
        if not missing.any():
            return drawn, outside
    # What never falls inside is put on the edge: the posterior is all but outside, and `outside` says so.
    edge = region.points(np.clip(region.unit(region.points(mixtures.draw(count, rng)).reshape(-1, size)), -1.0, 1.0))
    held = np.clip(edge, region.low, region.high).reshape(n, count, size)
    drawn[missing] = held[missing]
    return drawn, outside


def run_rounds(
    simulate: Simulate,
    observed: Array,
    prior: Region,
    simulations: int,
    settings: RoundSettings,
    seed: int,
    say: Say = lambda _: None,
    workers: Workers | None = None,
) -> Fitted:
    """Infer from observed statistics (S,); `simulate` gives statistics (n, S) of points (n, P) and seeds (n,).

    The networks are trained by `workers`, by default here.
    """
    workers = workers or LocalWorkers()
    rng = np.random.default_rng(seed)
    region = prior
    theta, statistics = np.empty((0, prior.centre.size)), np.empty((0, observed.size))
    fitted: Fitted | None = None
    for number, share in enumerate(settings.shares, start=1):
        count = max(64, round(share * simulations))
        say(f"round {number} of {len(settings.shares)}: {count} simulations")
        fresh = region.draw(count, rng)
        theta = np.concatenate([theta, fresh])
        statistics = np.concatenate([statistics, simulate(fresh, draw_seeds(count, rng))])
        say(f"round {number} of {len(settings.shares)}: density network")
        # Draws of earlier rounds that fall inside were uniform there too.
        used = region.contains(theta)
        size = settings.network if number == len(settings.shares) else settings.scout
        targets = region.unit(theta[used])
        network = workers.call(train, statistics[used], targets, size, int(rng.integers(2**31)))
        fitted = Fitted(region, network, theta[used], statistics[used], theta.shape[0])
        if number < len(settings.shares):
            draws, _ = fitted.draw(observed[None], _DRAWS, rng)
            region = region.shrunk(draws[0], settings.deviations)
    if fitted is None:
        raise ValueError("no round to run")
    return fitted


Mask = NDArray[np.bool_]

_LARGEST_TRIES = 400
# Of the box: keeps a region open where all draws press against an edge.
_SMALLEST_DEVIATION = 1e-5


@dataclass(frozen=True, slots=True)
class Region:
    """All points `centre + factor @ z` with every |z| <= 1 that lie in the box from `low` to `high` and in `within`.

    `centre`, `low`, `high` (P,), `factor` (P, P). Coordinates z are of order one, which is what the network sees.
    """

    low: Array
    high: Array
    centre: Array
    factor: Array
    within: Region | None = None

    @classmethod
    def box(cls, low: Array, high: Array) -> Region:
        """A whole box."""
        return cls(low, high, 0.5 * (low + high), np.diag(0.5 * (high - low)))

    def unit(self, theta: Array) -> Array:
        """Coordinates z (n, P) of points (n, P)."""
        return np.asarray(np.linalg.solve(self.factor, (theta - self.centre).T).T)

    def points(self, unit: Array) -> Array:
        """Points (..., P) of coordinates (..., P)."""
        return np.asarray(self.centre + unit @ self.factor.T)

    def contains(self, theta: Array) -> Mask:
        """Which points (n, P) are in it."""
        inside = ((theta >= self.low) & (theta <= self.high) & (np.abs(self.unit(theta)) <= 1.0)).all(axis=1)
        return np.asarray(inside if self.within is None else inside & self.within.contains(theta))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Uniform draws (count, P); raises RuntimeError if the region is all but empty."""
        size = self.centre.size
        found: list[Array] = []
        missing = count
        for _ in range(_LARGEST_TRIES):
            trial = self.points(rng.uniform(-1.0, 1.0, (4 * count, size)))
            kept = trial[self.contains(trial)][:missing]
            found.append(kept)
            missing -= kept.shape[0]
            if missing == 0:
                return np.concatenate(found)
        raise RuntimeError("the region to draw parameters from is all but empty")

    def shrunk(self, draws: Array, deviations: float) -> Region:
        """The part of this region within `deviations` standard deviations of draws (n, P), along their main axes."""
        scale = self.high - self.low
        covariance = np.cov((draws / scale).T) + _SMALLEST_DEVIATION**2 * np.eye(scale.size)
        variances, axes = np.linalg.eigh(covariance)
        factor = scale[:, None] * axes * (deviations * np.sqrt(variances))
        return Region(self.low, self.high, draws.mean(axis=0), factor, self)
