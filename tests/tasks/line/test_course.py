"""Courses: distance and its sign, extent, length, start, headings that stay on the line."""

import math

import numpy as np
import pytest

from disco_hw.tasks.circle import CircleTask
from disco_hw.tasks.line import PathTable
from disco_hw.tasks.line.course import stable_yaw, turned_tangents
from disco_hw.tasks.path import PathTask
from disco_hw.tasks.timed_path import TimedPathTask

CIRCLE = CircleTask(center_x_m=1.0, center_y_m=-2.0, radius_m=0.5)
CORNER = PathTask(path="corner.csv", points=((0.0, 0.0), (2.0, 0.0), (2.0, 1.0)))


def test_the_distance_to_a_path_is_positive_to_the_right_of_its_nearest_piece():
    course = CORNER.course()
    places = np.array([[1.0, -0.3], [1.0, 0.2], [2.4, 0.5], [1.7, 0.9], [-3.0, 0.0], [2.0, 3.0], [0.5, 0.0]])
    off_m = course.off_m(places)
    np.testing.assert_allclose(off_m[:4], [0.3, -0.2, 0.4, -0.3])
    np.testing.assert_allclose(np.abs(off_m[4:]), [3.0, 2.0, 0.0])


def test_a_circle_and_the_path_round_it_agree_on_the_side():
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    points = tuple((1.0 + 0.5 * math.cos(a), -2.0 + 0.5 * math.sin(a)) for a in angle)
    path, circle = PathTask(path="round.csv", points=points).course(), CIRCLE.course()
    places = np.random.default_rng(1).uniform((-1.0, -4.0), (3.0, 0.0), (500, 2))
    np.testing.assert_allclose(path.off_m(places), circle.off_m(places), atol=1e-4)
    assert path.length_m == pytest.approx(circle.length_m, rel=1e-4)
    assert path.middle_m == pytest.approx(circle.middle_m)
    assert path.reach_m == pytest.approx(circle.reach_m)
    assert path.start == pytest.approx(circle.start, abs=0.01)


def test_a_circle_is_measured_from_its_edge():
    course = CIRCLE.course()
    np.testing.assert_allclose(course.off_m(np.array([[1.0, -2.0], [2.0, -2.0]])), [-0.5, 0.5])
    np.testing.assert_allclose(course.off_m(course.outline_m()), 0.0, atol=1e-12)
    assert course.start == pytest.approx((1.5, -2.0, 0.5 * math.pi))


def test_many_positions_on_a_long_path_are_taken_in_parts():
    x = np.linspace(0.0, 100.0, 10_000)
    course = PathTask(path="long.csv", points=tuple((float(each), 0.0) for each in x)).course()
    places = np.column_stack((np.linspace(1.0, 99.0, 1500), np.linspace(-1.0, 1.0, 1500)))
    np.testing.assert_allclose(course.off_m(places), -places[:, 1], atol=1e-9)
    assert course.start == (0.0, 0.0, 0.0)
    assert (course.middle_m, course.reach_m) == ((50.0, 0.0), 50.0)


def test_the_speed_makes_no_other_course():
    assert CORNER.course() is PathTask(path="corner.csv", speed_m_s=0.1, points=CORNER.points).course()


def test_a_position_that_is_no_number_is_at_no_distance():
    off_m = CORNER.course().off_m(np.array([[1.0, 0.2], [math.nan, 0.0], [math.inf, 1.0]]))
    np.testing.assert_allclose(off_m, [-0.2, math.nan, math.nan])
    assert len(CORNER.course().off_m(np.empty((0, 2)))) == 0


def test_a_course_that_begins_with_a_rest_faces_where_it_goes():
    points = ((1.0, 0.0), (1.0, 0.0), (1.0, 2.0))
    course = TimedPathTask(path="p.csv", points=points, times_s=(0.0, 1.0, 9.0)).course()
    assert course.start == pytest.approx((1.0, 0.0, 0.5 * math.pi))
    np.testing.assert_allclose(course.off_m(np.array([[1.2, 1.0]])), [0.2])


@pytest.mark.parametrize("x_icr_m", [0.238, -0.238])
@pytest.mark.parametrize("first", [-120, 0, 70, 333])
def test_the_headings_along_a_part_of_a_line_are_those_along_all_of_it(x_icr_m, first):
    angles = np.linspace(0.0, 2.0 * math.pi, 200)
    path = PathTable(np.column_stack([np.cos(angles) + 0.3 * np.cos(2.0 * angles), np.sin(angles)]))
    assert path.closed
    count = len(path.table) - 1
    along = np.unwrap(np.arctan2(path.table[:-1, 3], path.table[:-1, 2]))
    yaw = stable_yaw(along, path.spacing_m, x_icr_m, True)
    begin, end = np.tan(0.5 * (yaw[:-1] - along)), np.tan(0.5 * (yaw[1:] - along))
    at = np.arange(first, first + 100) % count
    expected = np.column_stack([begin, end - begin])[at]
    np.testing.assert_allclose(turned_tangents(path, x_icr_m, first, first + 100), expected, atol=1e-12)
