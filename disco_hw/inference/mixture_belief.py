"""The network's mixture as a belief for the model: cut to the possible range, and with few components."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.inference.density_network import Mixtures
from disco_hw.inference.region import Region
from disco_hw.model import Gaussian, Mixture

Array = NDArray[np.float64]
Component = tuple[float, Array, Array]

_DRAWS = 4000
_FEWEST_INSIDE = 20
_LEAST_WEIGHT = 1e-4
_MERGE_COST = 0.1
_MOST_COMPONENTS = 4


def belief_of(
    mixtures: Mixtures, region: Region, low: Array, high: Array, names: tuple[str, ...], rng: np.random.Generator
) -> Mixture:
    """Belief from the first of `mixtures`, which is over a region's coordinates.

    Components that reach outside [low, high] (P,) are replaced by the moments of their part inside; a component that is
    all outside goes. Components that one Gaussian describes as well are merged. Raises ValueError if nothing is inside.
    """
    weights = np.exp(mixtures.log_weight[0])
    inverse = np.linalg.inv(mixtures.factor[0])
    covariances = inverse @ inverse.transpose(0, 2, 1)
    kept: list[Component] = []
    for weight, mean, covariance in zip(weights, mixtures.mean[0], covariances, strict=True):
        here = region.points(mean)
        spread = region.factor @ covariance @ region.factor.T
        draws = rng.multivariate_normal(here, spread, size=_DRAWS, method="cholesky")
        inside = draws[((draws >= low) & (draws <= high)).all(axis=1)]
        if inside.shape[0] < _FEWEST_INSIDE:
            continue
        share = inside.shape[0] / _DRAWS
        if share < 1.0:
            here, spread = inside.mean(axis=0), np.cov(inside.T)
        kept.append((float(weight) * share, here, spread))
    total = sum(weight for weight, _, _ in kept)
    if total < _LEAST_WEIGHT:
        raise ValueError("the posterior lies outside the prior's range")
    merged = _merged([part for part in kept if part[0] > _LEAST_WEIGHT * total], total)
    return Mixture(
        np.array([weight for weight, _, _ in merged]),
        tuple(Gaussian(names, mean, 0.5 * (spread + spread.T)) for _, mean, spread in merged),
    )


def _merged(parts: list[Component], total: float) -> list[Component]:
    """Merge the pair that costs least, until that cost is not small or few enough are left (Runnalls, 2007, eq. 21)."""
    parts = list(parts)
    while len(parts) > 1:
        pairs = [(i, j) for i in range(len(parts)) for j in range(i)]
        costs = [_cost(parts[i], parts[j]) for i, j in pairs]
        cheapest = int(np.argmin(costs))
        if costs[cheapest] > _MERGE_COST * total and len(parts) <= _MOST_COMPONENTS:
            break
        i, j = pairs[cheapest]
        joined = _together(parts[i], parts[j])
        parts = [part for index, part in enumerate(parts) if index not in (i, j)] + [joined]
    return sorted(parts, key=lambda part: -part[0])


def _together(one: Component, other: Component) -> Component:
    weight = one[0] + other[0]
    share, rest = one[0] / weight, other[0] / weight
    offset = one[1] - other[1]
    spread = share * one[2] + rest * other[2] + share * rest * np.outer(offset, offset)
    return weight, share * one[1] + rest * other[1], spread


def _cost(one: Component, other: Component) -> float:
    """Upper bound of the Kullback-Leibler divergence that merging two components costs."""
    weight, _, spread = _together(one, other)
    parts = ((weight, spread), (-one[0], one[2]), (-other[0], other[2]))
    return float(0.5 * sum(share * np.linalg.slogdet(covariance)[1] for share, covariance in parts))
