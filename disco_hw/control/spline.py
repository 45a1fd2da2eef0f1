"""Cubic B-splines: noise on a few knots becomes smooth noise over the whole horizon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

DEGREE = 3


def spline_basis(knots: int, horizon: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Clamped uniform cubic B-spline basis at the middle of each of `horizon` steps.

    Returns the first of the four control points that act at each step (T,) and their weights (T, 4), which sum to one.
    Raises ValueError for fewer than four knots.
    """
    if knots <= DEGREE:
        raise ValueError(f"a cubic spline needs at least {DEGREE + 1} knots, not {knots}")
    inner = np.linspace(0.0, 1.0, knots - DEGREE + 1)
    vector = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    middles = (np.arange(horizon) + 0.5) / horizon
    first = np.clip(np.searchsorted(inner, middles, side="right") - 1, 0, knots - DEGREE - 1)
    weights = np.ones((horizon, 1))
    # The recursion of de Boor (A Practical Guide to Splines, chapter X) from one degree to the next.
    for degree in range(1, DEGREE + 1):
        number = first[:, None] + DEGREE + np.arange(1, degree + 1)
        upper, lower = vector[number], vector[number - degree]
        share = weights / (upper - lower)
        weights = np.zeros((horizon, degree + 1))
        weights[:, :-1] = share * (upper - middles[:, None])
        weights[:, 1:] += share * (middles[:, None] - lower)
    return first.astype(np.int64), weights
