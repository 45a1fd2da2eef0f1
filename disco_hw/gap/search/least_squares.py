"""Least squares on whitened residuals: bounded Levenberg-Marquardt, and what its normal equations say by block."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data import Layout
from disco_hw.gap.search.unnamed_terms import ResidualChannel
from disco_hw.gap.settings import FitSettings

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted parameter vector.

    `cost` is half the sum of squares; `slope` (n, A) over the `active` entries, derivative of the residual, or what
    gives it when it is asked for; `precision` (A,) of what was expected of them, none if nothing was. `loose`: whether
    it was fitted only as closely as it takes to compete; `carried`: whether its slope is that of a neighbour.
    """

    vector: Array
    active: tuple[int, ...]
    cost: float
    residual: Array
    slope: Array | Callable[[], Array]
    precision: Array | None = None
    loose: bool = False
    carried: bool = False

    # Most fits only compete by their cost: nobody ever asks for their derivatives.
    @cached_property
    def jacobian(self) -> Array:
        """Derivative of the residual with respect to the active entries, (n, A)."""
        return self.slope() if callable(self.slope) else self.slope

    @cached_property
    def normal(self) -> Array:
        """Normal matrix, (A, A), of the residuals alone."""
        return np.asarray(self.jacobian.T @ self.jacobian)

    @cached_property
    def gradient(self) -> Array:
        """Derivative of the cost, (A,)."""
        return np.asarray(self.jacobian.T @ self.residual)

    def information(self) -> Array:
        """Return the normal matrix (A, A) of the residuals, plus the precision of the prior."""
        return self.normal if self.precision is None else self.normal + np.diag(self.precision)

    def covariance(self) -> Array:
        """Covariance of the active entries under the noise model, (A, A); pseudo-inverse where nothing is known."""
        return inverse(self.information())


def inverse(matrix: Array) -> Array:
    """Inverse of a normal matrix, scaled first; directions without information get a large variance."""
    if not matrix.size:
        return matrix
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    unit = matrix / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(unit)
    return np.asarray((vectors / np.maximum(values, 1e-10)) @ vectors.T / np.outer(scale, scale))


def within(covariance: Array, low: Array, high: Array) -> Array:
    """Limit the covariance (A, A) of entries that lie in the ranges from `low` to `high` (A,).

    A standard deviation is at most that of a uniform distribution over the range; correlations stay.
    """
    deviations = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    share = np.minimum(1.0, (high - low) / 12.0**0.5 / deviations)
    return np.asarray(covariance * np.outer(share, share))


def known(part: Array, total: Array, settings: FitSettings) -> NDArray[np.bool_]:
    """Which parameters (A,) a part of a log determines, from its normal matrix and the whole log's, (A, A) each.

    What is hardly determined, a limit that was reached elsewhere only, would be moved anywhere.
    """
    return np.asarray(np.diag(part) > settings.least_known_share * np.diag(total))


def jacobian(
    residual: Callable[[Array], Array],
    vector: Array,
    active: tuple[int, ...],
    layout: Layout,
    base: Array,
    known: Mapping[int, Array] | None = None,
) -> Array:
    """Return the derivative (n, A) of the residual by differences within bounds; `base` is the residual at `vector`.

    `known`: columns (n,) of entries for which they were taken before, at the same vector.
    """
    out = np.empty((base.size, len(active)))
    for place, index in enumerate(active):
        if known is not None and index in known:
            out[:, place] = known[index]
            continue
        moved = vector.copy()
        moved[index] += layout.step[index]
        if moved[index] > layout.high[index]:
            moved[index] = vector[index] - layout.step[index]
        out[:, place] = (residual(moved) - base) / (moved[index] - vector[index])
    return out


def sensitivity(channel: ResidualChannel, vector: Array, places: tuple[int, ...], residual: Array) -> Array:
    """Return the derivative of a channel's residual with respect to some entries, (n, len(places))."""
    return jacobian(channel.residual, vector, places, channel.layout, residual)


def solve(slope: Array, gradient: Array) -> Array:
    """Solve the normal equations of `slope` (n, A) for a right side (A,)."""
    return np.asarray(inverse(slope.T @ slope) @ gradient)


def fit(
    channel: ResidualChannel,
    start: Array | Fit,
    active: tuple[int, ...],
    iterations: int | None = None,
    loose: bool = False,
) -> Fit:
    """Fit the `active` entries from `start`; what a log does not determine stays near what is expected.

    A start that is a fit of the same channel lends what it knows of where it ended. A `loose` fit takes derivatives
    along where a step gained what it promised, by the least change that agrees with it (Broyden, 1965); its cost is
    good to a small part of a nat.

    Levenberg-Marquardt within bounds (Marquardt, 1963); `iterations` as in the settings unless said.
    """
    layout = channel.layout
    chosen = list(active)
    low, high = layout.low[chosen], layout.high[chosen]
    precision, expected = layout.precision[chosen], layout.neutral[chosen]
    has_prior = bool(precision.any())

    def total(residual: Array, vector: Array) -> float:
        cost = 0.5 * float(residual @ residual)
        return cost + 0.5 * float(precision @ (vector[chosen] - expected) ** 2) if has_prior else cost

    residual = channel.residual
    if isinstance(start, Fit):
        vector, now = start.vector, start.residual
        known_columns = dict(zip(start.active, start.jacobian.T, strict=True))
    else:
        vector, now, known_columns = start.copy(), residual(start), {}
    cost = total(now, vector)
    slope: Array | Callable[[], Array] = partial(jacobian, residual, vector, active, layout, now, known_columns)
    damping, carried = 1e-3, isinstance(start, Fit) and start.carried
    settings = channel.settings.fit
    for _ in range((settings.iterations if iterations is None else iterations) if active else 0):
        slope = slope() if callable(slope) else slope
        # Derivatives that were taken along make the last steps shorter.
        enough_nats = 0.1 * settings.enough_nats if carried else settings.enough_nats
        normal, gradient = slope.T @ slope, slope.T @ now
        if has_prior:
            normal, gradient = normal + np.diag(precision), gradient + precision * (vector[chosen] - expected)
        scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.max(np.diag(normal))), 1e-30))
        gained, before, was = 0.0, vector, now
        for _ in range(6):
            step = -np.linalg.solve(normal + np.diag(damping * scale), gradient)
            trial = vector.copy()
            trial[chosen] = np.clip(vector[chosen] + step, low, high)
            there = residual(trial)
            cost_there = total(there, trial)
            if cost_there < cost:
                gained = cost - cost_there
                vector, now, cost = trial, there, cost_there
                damping = max(damping * 0.1, 1e-9)
                break
            damping *= 10.0
        if gained > 0.0:
            moved = (vector - before)[chosen]
            carried = loose and _as_promised(gained, gradient, normal, moved, settings)
        elif carried:
            # Derivatives that were taken along may lead nowhere.
            carried, damping = False, 1e-3
        else:
            break
        partial_jacobian = partial(jacobian, residual, vector, active, layout, now)
        slope = _carried(slope, moved, now - was, scale) if carried else partial_jacobian
        if 0.0 < gained < enough_nats:
            break
    if carried:
        slope = partial(jacobian, residual, vector, active, layout, now)
    return Fit(vector, active, 0.5 * float(now @ now), now, slope, precision if has_prior else None, loose)


def _as_promised(gained: float, gradient: Array, normal: Array, step: Array, settings: FitSettings) -> bool:
    """Whether a step (A,) gained about what derivatives at its beginning promised, and so hardly changed them."""
    promised = -float(gradient @ step + 0.5 * step @ normal @ step)
    return abs(gained - promised) < settings.promised_share * promised


def _carried(slope: Array, step: Array, change: Array, scale: Array) -> Array:
    """Change derivatives (n, A) least, so that a step (A,) gives the `change` (n,) of residuals (Broyden, 1965)."""
    along = scale * step
    return np.asarray(slope + np.outer(change - slope @ step, along / float(along @ step)))


def by_block(found: Fit, block: Index, blocks_each: int = 1) -> tuple[Array, Array]:
    """Return normal matrices (B, A, A) and gradients (B, A) by block; `blocks_each` neighbours count as one."""
    label = np.unique(block // blocks_each, return_inverse=True)[1]
    sizes, width = np.bincount(label), len(found.active)
    normal, gradient = np.zeros((sizes.size, width, width)), np.zeros((sizes.size, width))
    inside = np.split(np.argsort(label, kind="stable"), np.cumsum(sizes)[:-1])
    for b, rows in enumerate(inside):
        part = found.jacobian[rows]
        normal[b] = part.T @ part
        gradient[b] = part.T @ found.residual[rows]
    return normal, gradient
