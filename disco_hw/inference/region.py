"""Where parameters are drawn from: the prior's box, or the part of it that a round of inference has left.

Within a region draws are uniform, so the prior over the proposal is one constant there and the network's density is the
posterior as it stands: no division of mixtures, which fails for components wider than the proposal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
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
