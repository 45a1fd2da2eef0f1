"""The level and the line that most stretches agree on, whatever the others show."""

import numpy as np
import pytest

from disco_hw.gap.data.stamp_clock import _level, _line


@pytest.mark.parametrize(
    ("delays", "squares", "level"),
    [
        # Three that are alike, and two that are further off than counts.
        ([0.5, 0.55, 0.6, 0.0, 0.0], 0.025, 0.55),
        # Two that are alike against some of which each is far off from the next.
        ([0.0, 0.0, 0.15, 0.3, 0.45], 0.03, 0.0),
        # What is just so far off does not agree.
        ([0.0, 0.0, 0.1], 0.01, 0.0),
        # The squares are about the mean of those that agree, the level is the one in the middle.
        ([0.0, 0.01, 0.05, 9.0], 0.01 + 0.0014, 0.01),
    ],
)
def test_a_level_is_that_of_most(delays, squares, level):
    for turned in (1.0, -1.0):
        assert _level(turned * np.array(delays), 0.1) == pytest.approx((squares, turned * level), abs=1e-12)
    # Without a bound it is the median.
    assert _level(np.array([1.0, 2.0, 6.0]), np.inf) == pytest.approx((14.0, 2.0))


@pytest.mark.parametrize("slope", [2.0, -0.5])
def test_a_line_is_that_of_most(slope):
    x = np.array([-0.5, -0.4, -0.1, 0.2, 0.5])
    off = np.array([0.0, 0.0, 0.3, 0.0, -0.2])
    assert _line(x, 0.7 + slope * x + off, 0.1) == pytest.approx((0.02, slope))
    # Two at the end of three that lie on none: the line through the first and its neighbour.
    assert _line(np.array([0.0, 1.0, 5.0]), np.array([0.0, slope, 9.0]), 0.1)[1] == pytest.approx(slope)


@pytest.mark.parametrize(
    ("delays", "bound", "squares", "slope"),
    [
        # It is fitted to those that are not just as far off as counts.
        ([0.0, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.0], 0.25, 0.25**2, 0.0),
        # One that is far off does not turn it, and two that are little do.
        ([0.0, 0.1, 0.2, 0.3, 0.4, 0.8], 0.1, 0.01, 0.1),
        ([0.0, 0.16, 0.2, 0.3, 0.34, 0.5], 0.1, 0.0072 - 0.18**2 / 17.5, 0.1 - 0.18 / 17.5),
        # Four that are nearly on a line are more than three that are.
        ([0.0, -1.0, -2.0, 5.0, 5.05, 5.05, 5.0], 0.1, 0.0325, 0.0),
    ],
)
def test_a_line_of_even_stretches_is_that_of_those_that_lie_near_it(delays, bound, squares, slope):
    assert _line(np.arange(float(len(delays))), np.array(delays), bound) == pytest.approx((squares, slope), abs=1e-9)
