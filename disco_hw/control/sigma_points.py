"""Sigma points of the unscented transform, with the exact square root of the covariance.

van der Merwe, "Sigma-point Kalman filters for probabilistic inference in dynamic state-space models" (2004); the
paper's equation for sigma points, with W0c = W0m + 1 - alpha^2 + xi (the paper prints the primary scaling for alpha).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SigmaPoints:
    """Points (L, n) with L = 2n + 1, weights of the mean (L,) and of the covariance (L,); the first is the mean."""

    points: Array
    mean_weights: Array
    covariance_weights: Array


def sigma_points(
    mean: Array, covariance: Array, alpha: float, kappa: float = 0.0, xi: float = 2.0, basis: Array | None = None
) -> SigmaPoints:
    """Sigma points of a mean (n,) and a covariance (n, n).

    The points are mean +- columns of a square root C of (n + nu) covariance, C C' = (n + nu) covariance, so that
    sum w d d' is the covariance exactly, correlated or not. C is the lower Cholesky factor; in the coordinates of
    `basis` (n, n), if given, whose last column is then the direction of the last points. alpha = 1 gives non-negative
    weights. Raises ValueError unless alpha > 0 and the covariance is positive definite.
    """
    n = mean.size
    if not alpha > 0.0:
        raise ValueError(f"alpha must be positive, not {alpha}")
    spread = alpha**2 * (n + kappa)
    if spread <= 0.0:
        raise ValueError(f"n + kappa must be positive, not {n + kappa}")
    axes = np.eye(n) if basis is None else basis
    inverse = np.linalg.inv(axes)
    try:
        factor = axes @ np.linalg.cholesky(spread * (inverse @ covariance @ inverse.T))
    except np.linalg.LinAlgError:
        raise ValueError("the covariance is not positive definite") from None
    points = np.vstack([mean, mean + factor.T, mean - factor.T])
    mean_weights = np.full(2 * n + 1, 0.5 / spread)
    mean_weights[0] = 1.0 - n / spread
    covariance_weights = mean_weights.copy()
    covariance_weights[0] += 1.0 - alpha**2 + xi
    return SigmaPoints(points, mean_weights, covariance_weights)
