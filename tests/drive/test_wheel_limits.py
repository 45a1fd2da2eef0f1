"""Tests of what counts as a wheel's limit."""

import pytest

from disco_hw.drive.script import ReachedLimits


def limits(**observed):
    """Manoeuvres with their samples (commanded, measured) of the left wheel; the right one does as commanded."""
    found = ReachedLimits()
    for manoeuvre, samples in observed.items():
        for commanded, measured in samples:
            found.observe(manoeuvre, (commanded, commanded), (measured, commanded))
    return found


def test_what_was_reached_is_the_limit_each_way():
    found = limits(ahead=[(6.0, 4.5)] * 3, back=[(-6.0, -3.0)] * 3)
    assert found.within((6.0, 6.0)) == (4.5, 6.0)
    assert found.within((-6.0, -6.0)) == (-3.0, -6.0)
    assert found.within((2.0, 0.0)) == (1.5, 0.0)
    assert found.describe() == "found: left -3.0 to +4.5, right -6.0 to +6.0 rad/s"


def test_the_manoeuvre_where_it_reached_least_counts():
    assert limits(straight=[(6.0, 6.0)] * 9, turning=[(6.0, 3.0)]).within((6.0, 0.0))[0] == 3.0


def test_single_bad_samples_do_not_count():
    assert limits(ahead=[(6.0, 4.5)] * 4 + [(6.0, 0.0)]).within((6.0, 0.0))[0] == 4.5


@pytest.mark.parametrize(("measured", "limit"), [(5.8, 6.0), (7.0, 6.0), (-1.0, 0.0)])
def test_close_is_reached_and_the_wrong_way_is_nothing(measured, limit):
    assert limits(ahead=[(6.0, measured)]).within((6.0, 0.0))[0] == limit


def test_a_measurement_that_is_no_number_limits_nothing():
    assert limits(ahead=[(6.0, float("nan"))]).within((6.0, 0.0))[0] == 6.0
