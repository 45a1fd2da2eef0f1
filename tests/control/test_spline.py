"""The spline basis: sums to one, smooth, agrees with scipy's spline."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from disco_hw.control.optimiser import spline_basis


@pytest.mark.parametrize(("knots", "horizon"), [(4, 2), (5, 50), (8, 50), (8, 7), (30, 50)])
def test_basis_is_that_of_a_clamped_cubic_spline(knots, horizon):
    first, weights = spline_basis(knots, horizon)
    assert first.min() >= 0
    assert first.max() <= knots - 4
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    control = np.random.default_rng(0).standard_normal(knots)
    vector = np.r_[0, 0, 0, np.linspace(0, 1, knots - 2), 1, 1, 1]
    expected = BSpline(vector, control, 3)((np.arange(horizon) + 0.5) / horizon)
    np.testing.assert_allclose((weights * control[first[:, None] + np.arange(4)]).sum(axis=1), expected, atol=1e-12)
