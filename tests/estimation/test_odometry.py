"""Exact-arc odometry against numerical integration and finite differences."""

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.estimation.odometry import OdometryParameters, Pose, advance, arc, moved, wrap
from tests.tables import examples

PARAMETERS = OdometryParameters(0.061, 0.415, 0.238)
# Straight, spin in place, bends of both signs, reverse, one wheel, and turns on both sides of the series' threshold.
TURNS = [(3.0, 3.0), (-2.0, 2.0), (3.0, 3.6), (3.6, 3.0), (-4.0, -3.0), (0.0, 5.0), (20.0, -35.0)]
TURNS += [(2.0, 2.0 + 2e-4 * 0.415 / 0.061 * factor) for factor in (0.0, 0.5, 0.999, 1.001, 4.0)]
START = Pose(1.0, -2.0, 2.5)


NODES, WEIGHTS = np.polynomial.legendre.leggauss(60)


def integrated(parameters, pose, left, right):
    """Gauss's rule on the tracked point's velocity: x' = v cos + omega x_icr sin, y' = v sin - omega x_icr cos."""
    v = parameters.wheel_radius_m * (left + right) / 2
    omega = parameters.wheel_radius_m * (right - left) / parameters.axial_distance_m
    yaw = pose.yaw_rad + omega * (NODES + 1.0) / 2.0
    slide = omega * parameters.x_icr_m
    x = pose.x_m + np.average(v * np.cos(yaw) + slide * np.sin(yaw), weights=WEIGHTS)
    y = pose.y_m + np.average(v * np.sin(yaw) - slide * np.cos(yaw), weights=WEIGHTS)
    return np.array([x, y, pose.yaw_rad + omega])


@pytest.mark.parametrize(("left", "right"), TURNS)
@pytest.mark.parametrize("x_icr", [0.238, 0.0, -0.3])
def test_arc_is_exact(left, right, x_icr):
    parameters = OdometryParameters(0.061, 0.415, x_icr)
    end = moved(START, arc(parameters, left, right))
    expected = integrated(parameters, START, left, right)
    np.testing.assert_allclose([end.x_m, end.y_m], expected[:2], atol=1e-9)
    assert math.remainder(end.yaw_rad - expected[2], math.tau) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("left", "right"), TURNS)
def test_derivatives_are_those_of_finite_differences(left, right):
    r, a, x_icr = PARAMETERS.wheel_radius_m, PARAMETERS.axial_distance_m, PARAMETERS.x_icr_m

    def displacement(distance=0.0, turn=0.0, x_icr_change=0.0):
        # Wheel turns that change the distance, the turn or x_icr alone.
        half = turn * a / r / 2
        motion = arc(
            OdometryParameters(r, a, x_icr + x_icr_change), left + distance / r - half, right + distance / r + half
        )
        return np.array([motion.forward_m, motion.left_m])

    def difference(**change):
        ((name, step),) = change.items()
        return (displacement(**{name: step}) - displacement(**{name: -step})) / (2 * step)

    motion = arc(PARAMETERS, left, right)
    tolerance = {"atol": 1e-7, "rtol": 1e-7}
    np.testing.assert_allclose(
        [motion.forward_by_distance, motion.left_by_distance], difference(distance=1e-5), **tolerance
    )
    np.testing.assert_allclose([motion.forward_by_turn, motion.left_by_turn], difference(turn=1e-5), **tolerance)
    np.testing.assert_allclose(
        [motion.forward_by_x_icr, motion.left_by_x_icr], difference(x_icr_change=1e-3), **tolerance
    )


def test_straight_and_spin_read_off_by_hand():
    straight = arc(PARAMETERS, 2.0, 2.0)
    assert (straight.forward_m, straight.left_m, straight.turn_rad) == (0.122, 0.0, 0.0)
    assert straight.rolled_m == 0.122
    # A quarter turn on the spot about the centre of rotation x_icr ahead: it stays, the tracked point swings right.
    quarter = math.pi / 4 * 0.415 / 0.061
    spin = moved(Pose(0.0, 0.0, 0.0), arc(PARAMETERS, -quarter, quarter))
    assert (spin.x_m, spin.y_m, spin.yaw_rad) == pytest.approx((0.238, -0.238, math.pi / 2))


@examples(quick=30, every=100, left=st.floats(-30, 30), right=st.floats(-30, 30), part=st.floats(0.01, 0.99))
def test_an_arc_may_be_cut_anywhere(left, right, part):
    uncut = moved(START, arc(PARAMETERS, left, right))
    first = moved(START, arc(PARAMETERS, part * left, part * right))
    both = moved(first, arc(PARAMETERS, left - part * left, right - part * right))
    assert (both.x_m, both.y_m) == pytest.approx((uncut.x_m, uncut.y_m), abs=1e-12)
    assert math.remainder(both.yaw_rad - uncut.yaw_rad, math.tau) == pytest.approx(0.0, abs=1e-12)


def test_advance_follows_the_segments_in_order():
    segments = [(3.0, 4.0, 0.1), (4.0, 3.0, 0.25), (0.0, 0.0, 1.0), (-2.0, 2.0, 0.05)]
    pose = advance(PARAMETERS, START, segments)
    expected = START
    for left, right, duration in segments:
        expected = Pose(*integrated(PARAMETERS, expected, left * duration, right * duration).tolist())
    assert (pose.x_m, pose.y_m) == pytest.approx((expected.x_m, expected.y_m), abs=1e-9)
    assert pose.yaw_rad == pytest.approx(wrap(expected.yaw_rad), abs=1e-12)
    assert advance(PARAMETERS, START, []) == START


def test_wrap():
    assert wrap(math.pi) == math.pi
    assert wrap(-math.pi) == math.pi
    assert wrap(3 * math.pi + 0.1) == pytest.approx(-math.pi + 0.1)
    assert wrap(-7.0) == pytest.approx(-7.0 + math.tau)
