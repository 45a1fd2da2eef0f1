"""The cost of touching a shape, and that shapes which are passed over could cost nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.control.kernel.avoid import (
    COLUMNS,
    TOUCH_COST,
    TOUCH_COST_PER_M,
    Area,
    centre_of,
    is_beyond,
    touch_cost,
    touch_reach,
)
from disco_hw.jit import kernel_function
from tests.tables import examples

HALF_LENGTH_M, HALF_WIDTH_M, AHEAD_M, KEEP_M, STEP_S = 0.25, 0.2, 0.05, 0.03, 0.1
WALL = (-5.0, 1.0, 1.0, 0.0, 10.0, 0.0, 0.0, 0.0)
"""Begin x, y, direction x, y, length, radius, velocity x, y."""


def area_of(*shapes) -> Area:
    rows = np.array(shapes, np.float32)
    body = np.array([HALF_LENGTH_M, HALF_WIDTH_M, AHEAD_M, KEEP_M, STEP_S, 0.0, 0.0], np.float32)
    return Area(rows.ravel(), np.array([len(rows)]), body, np.zeros(14, np.float32), np.zeros(len(rows)))


@kernel_function
def centred(area, pose, cosine, sine):
    return centre_of(area, pose, cosine, sine)


@kernel_function
def passed_over(area, time_s, middle, around_m):
    return is_beyond(area, 0, time_s, middle, around_m)


@kernel_function
def reach(area, forward):
    return touch_reach(area, forward)


@kernel_function
def touched(area, time_s, place, cosine, sine):
    return touch_cost(area, 0, time_s, place, cosine, sine)


def cost(area: Area, x: float, y: float, yaw: float, forward: float = 0.0, time_s: float = 0.0) -> float:
    return float(touched(area, time_s, (x, y, forward), math.cos(yaw), math.sin(yaw)))


@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 2, 2.0, -2.5])
@pytest.mark.parametrize("overlap_m", [-0.01, 0.01, 0.2])
def test_beside_a_wall_the_overlap_is_that_of_the_nearest_corner(yaw, overlap_m):
    reach_m = HALF_LENGTH_M * abs(math.sin(yaw)) + HALF_WIDTH_M * abs(math.cos(yaw))
    y = 1.0 - KEEP_M - reach_m + overlap_m - AHEAD_M * math.sin(yaw)
    expected = 0.0 if overlap_m < 0.0 else TOUCH_COST + TOUCH_COST_PER_M * overlap_m
    assert cost(area_of(WALL), 0.3, y, yaw) == pytest.approx(expected, rel=1e-3)


def test_a_faster_robot_keeps_farther_away_by_half_of_what_is_not_looked_at():
    y = 1.0 - KEEP_M - HALF_WIDTH_M - 0.02
    assert cost(area_of(WALL), 0.0, y, 0.0, forward=0.1) == 0.0
    assert cost(area_of(WALL), 0.0, y, 0.0, forward=-0.3) == pytest.approx(TOUCH_COST + TOUCH_COST_PER_M * 0.01, 1e-3)


def test_a_circle_is_met_where_its_velocity_takes_it():
    person = area_of((2.0, 0.0, 0.0, 0.0, 0.0, 0.3, -0.5, 0.0))
    touches_from_s = (2.0 - 0.3 - AHEAD_M - HALF_LENGTH_M - KEEP_M) / 0.5
    assert cost(person, 0.0, 0.0, 0.0, time_s=touches_from_s - 0.02) == 0.0
    assert cost(person, 0.0, 0.0, 0.0, time_s=touches_from_s + 0.02) == pytest.approx(TOUCH_COST + 8.0, rel=1e-2)


coordinate = st.floats(-2.0, 2.0, width=32)
angle = st.floats(-4.0, 4.0, width=32)
speed = st.floats(-1.0, 1.0, width=32)
shape = st.tuples(coordinate, coordinate, angle, st.floats(0.0, 3.0), st.floats(0.0, 0.5), speed, speed)


@examples(
    quick=100,
    every=400,
    shape=shape,
    samples=st.lists(st.tuples(coordinate, coordinate, angle, speed), min_size=1, max_size=6),
    time_s=st.floats(0.0, 4.0),
)
def test_a_shape_beyond_the_circle_around_all_samples_costs_none_of_them_anything(shape, samples, time_s):
    x, y, direction, length, radius, vx, vy = shape
    area = area_of((x, y, math.cos(direction), math.sin(direction), length, radius, vx, vy))
    middle = centred(area, samples[0], math.cos(samples[0][2]), math.sin(samples[0][2]))
    around_m = 0.0
    for x, y, yaw, _ in samples:
        center = centred(area, (x, y, 0.0), math.cos(yaw), math.sin(yaw))
        around_m = max(around_m, math.dist(center, middle))
    around_m += reach(area, max(abs(forward) for *_, forward in samples))
    costs = [cost(area, x, y, yaw, forward, time_s) for x, y, yaw, forward in samples]
    assert not passed_over(area, time_s, middle, around_m) or max(costs) == 0.0


@pytest.mark.parametrize(("gap_m", "beyond"), [(-0.002, False), (0.002, True)])
def test_a_wall_is_passed_over_from_the_reach_of_the_footprint_on(gap_m, beyond):
    area = area_of(WALL)
    reach_m = math.hypot(HALF_LENGTH_M, HALF_WIDTH_M) + KEEP_M + 0.3 * STEP_S
    middle = (0.0, 1.0 - reach_m - gap_m)
    assert reach(area, -0.3) == pytest.approx(reach_m, abs=1.1e-3)
    assert passed_over(area, 0.0, middle, reach(area, -0.3)) is beyond
    assert COLUMNS == 8
