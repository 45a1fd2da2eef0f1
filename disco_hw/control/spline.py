"""Cubic B-splines: noise on a few knots becomes smooth noise over the whole horizon."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

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
    dense = BSpline.design_matrix(middles, vector, DEGREE).toarray()
    first = np.clip(np.searchsorted(inner, middles, side="right") - 1, 0, knots - DEGREE - 1)
    weights = np.take_along_axis(dense, first[:, None] + np.arange(DEGREE + 1), axis=1)
    return first.astype(np.int64), weights
