"""The clearance of a footprint equals that of thousands of points of it, and never changes faster than a corner."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import FREE_M, Boundaries, MovingCircle, along_line, first_breach, task_breach
from tests.tables import examples

FOOTPRINT = Footprint(0.5, 0.4, 0.05)
ROOM = ((-2.0, -1.5), (2.0, -1.5), (2.0, 1.5), (-2.0, 1.5))
L_SHAPED = ((-2.0, -2.0), (2.0, -2.0), (2.0, 0.0), (0.0, 0.0), (0.0, 2.0), (-2.0, 2.0))


def clearance(fence: Fence, *pose: float, obstacles=(), time_s: float = 0.0, footprint: Footprint = FOOTPRINT) -> float:
    found = Boundaries(footprint, fence, obstacles).clearance_m(np.array([pose]), np.array([time_s]))
    assert found.shape == (1,)
    return float(found[0])


@pytest.mark.parametrize(
    ("fence", "pose", "expected"),
    [
        (Fence(), (0, 0, 0), FREE_M),
        (Fence(keep_in=ROOM), (0, 0, 0), 1.3),
        (Fence(keep_in=ROOM), (1.5, 0, 0), 0.2),
        (Fence(keep_in=ROOM[::-1]), (1.5, 0, 0), 0.2),
        (Fence(keep_in=ROOM), (1.5, 0, math.pi), 0.3),
        (Fence(keep_in=ROOM), (0, 1.2, math.pi / 2), 0.0),
        (Fence(keep_in=ROOM), (1.75, 0, 0), -0.05),
        (Fence(keep_in=ROOM), (2.15, 0, 0), -0.45),
        (Fence(keep_in=ROOM), (3.0, 0, 0), -1.3),
        (Fence(keep_in=L_SHAPED), (-0.25, -0.1, 0), -0.05),
        (Fence(keep_in=L_SHAPED), (-0.4, -0.3, 0), math.hypot(0.1, 0.1)),
        (Fence(keep_in=Circle((0, 0), 2.0)), (0, 0, 0), 2.0 - math.hypot(0.3, 0.2)),
        (Fence(keep_in=Circle((0, 0), 2.0)), (1.95, 0, 0), 2.0 - math.hypot(2.25, 0.2)),
        (Fence(keep_out=(Circle((1.0, 0.0), 0.15),)), (0, 0, 0), 0.55),
        (Fence(keep_out=(Circle((0.0, 1.0), 0.15),)), (0, 0, 0), 0.65),
        (Fence(keep_out=(Circle((0.6, 0.6), 0.1),)), (0, 0, 0), math.hypot(0.3, 0.4) - 0.1),
        (Fence(keep_out=(Circle((0.05, 0.0), 0.1),)), (0, 0, 0), -0.2 - 0.1),
        (Fence(keep_out=(Circle((0.2, 0.0), 0.1),)), (0, 0, 0), -0.1 - 0.1),
        (Fence(keep_out=(((1, -1), (2, -1), (2, 1), (1, 1)),)), (0, 0, 0), 0.7),
        (Fence(keep_out=(((0.28, -1), (0.29, -1), (0.29, 1), (0.28, 1)),)), (0, 0, 0), -0.02),
        (Fence(keep_out=(((-1, -1), (1, -1), (1, 1), (-1, 1)),)), (0, 0, 0), -0.8),
        (Fence(keep_out=(((0.25, 0.0), (0.9, -0.1), (0.9, 0.1)),)), (0, 0, 0), -0.05),
    ],
)
def test_known_places(fence, pose, expected):
    found = clearance(fence, *pose)
    assert found == pytest.approx(expected, abs=0.0051 if expected < 0.0 else 1e-9)
    assert (found < 0.0) == (expected < 0.0)


def test_the_nearest_of_all_shapes_counts():
    fence = Fence(keep_in=ROOM, keep_out=(Circle((1.0, 0.0), 0.15), ((0, 0.5), (1, 0.5), (1, 1))))
    each = Boundaries(FOOTPRINT, fence).clearances_m(np.array([[0.0, 0.0, 0.0], [0.0, -0.5, 0.0]]))
    assert each.shape == (2, 4)
    np.testing.assert_allclose(each[0, 1:], [0.55, 1.3, 0.3])
    assert clearance(fence, 0, 0, 0) == pytest.approx(0.3)


def test_an_obstacle_is_where_its_velocity_takes_it():
    pedestrian = MovingCircle(2.0, 0.0, 0.3, -0.5, 0.0)
    assert clearance(Fence(), 0, 0, 0, obstacles=[pedestrian]) == pytest.approx(1.4)
    assert clearance(Fence(), 0, 0, 0, obstacles=[pedestrian], time_s=2.0) == pytest.approx(0.4)
    aside = MovingCircle(0.0, 2.0, 0.3, 0.0, -0.5)
    assert clearance(Fence(), 0, 0, 0, obstacles=[aside], time_s=2.0) == pytest.approx(0.5)
    bounds = Boundaries(FOOTPRINT, Fence(keep_out=(Circle((0, -1), 0.1),)), [pedestrian])
    bounds.set_obstacles([])
    assert bounds.clearance_m(np.zeros((1, 3)))[0] == pytest.approx(0.7)


def test_what_is_far_away_is_cut_off_where_that_is_asked():
    bounds = Boundaries(FOOTPRINT, Fence(keep_in=ROOM, keep_out=(((1.5, 1), (1.6, 1), (1.5, 1.1)),)))
    near = np.array([[1.5, 0.0, 0.0], [1.6, 0.0, 0.3]])
    np.testing.assert_allclose(bounds.clearance_m(near, within_m=0.5), bounds.clearance_m(near))
    np.testing.assert_allclose(bounds.clearance_m(np.zeros((1, 3)), within_m=0.5), 0.5)
    # Outside the depth is the same, however far that is.
    far = np.array([[5.0, 0.0, 0.0]])
    np.testing.assert_allclose(bounds.clearance_m(far, within_m=0.1), bounds.clearance_m(far))


def points_of(footprint: Footprint, pose) -> np.ndarray:
    """The footprint's points, ten millimetres apart, its sides among them."""
    x = np.linspace(-0.5, 0.5, 51) * footprint.length + footprint.ahead
    y = np.linspace(-0.5, 0.5, 41) * footprint.width
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.stack(
        [pose[0] + cos * grid[:, 0] - sin * grid[:, 1], pose[1] + sin * grid[:, 0] + cos * grid[:, 1]], axis=1
    )


def off_polygon(points: np.ndarray, polygon) -> np.ndarray:
    """Signed distance of points from a polygon, positive within: by winding angles, edge after edge."""
    best, winding = np.full(len(points), np.inf), np.zeros(len(points))
    for begin, end in zip(polygon, [*polygon[1:], polygon[0]], strict=True):
        a, b = np.array(begin) - points, np.array(end) - points
        winding += np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1))
        way = b - a
        part = np.clip(-(a * way).sum(axis=1) / (way**2).sum(axis=1), 0.0, 1.0)
        best = np.minimum(best, np.hypot(*(a + part[:, None] * way).T))
    return np.where(np.abs(winding) > 3.0, best, -best)


places = st.floats(-2.6, 2.6)
poses = st.tuples(places, places, st.floats(-4.0, 4.0))
star = st.lists(st.floats(0.4, 2.5), min_size=3, max_size=9).map(
    lambda radii: tuple(
        (r * math.cos(2 * math.pi * k / len(radii)), r * math.sin(2 * math.pi * k / len(radii)))
        for k, r in enumerate(radii)
    )
)


@examples(quick=80, every=250, pose=poses, polygon=star, keep_in=st.booleans())
def test_the_clearance_to_any_polygon_is_that_of_the_footprints_points(pose, polygon, keep_in):
    fence = Fence(keep_in=polygon) if keep_in else Fence(keep_out=(polygon,))
    signed = off_polygon(points_of(FOOTPRINT, pose), polygon) * (1.0 if keep_in else -1.0)
    found = clearance(fence, *pose)
    if found > 0.0:
        assert signed.min() >= found - 1e-9
        assert signed.min() == pytest.approx(found, abs=0.011)
    else:
        # An edge or a corner that reaches in by less than the points are apart may lie between them.
        assert signed.min() <= 0.011
        assert found <= signed[[0, 50, -51, -1]].min() + 1e-9


@examples(quick=60, every=200, first=poses, second=poses, polygon=star)
def test_the_clearance_changes_by_no_more_than_a_corner_moves(first, second, polygon):
    fence = Fence(keep_in=polygon, keep_out=(Circle((0.3, 0.2), 0.2),))
    bounds = Boundaries(FOOTPRINT, fence, [MovingCircle(-1.0, 0.5, 0.3)])
    corners = np.array([np.array(points_of(FOOTPRINT, one))[[0, 50, -51, -1]] for one in (first, second)])
    moved = np.hypot(*(corners[0] - corners[1]).T).max()
    a, b = bounds.clearance_m(np.array([first, second]))
    if min(a, b) > 0.0:
        assert abs(a - b) <= moved + 1e-9


def test_many_poses_at_once_are_each_as_alone():
    rng = np.random.default_rng(1)
    many = np.column_stack([rng.uniform(-2.5, 2.5, (60, 2)), rng.uniform(-3, 3, 60)])
    keep_out = (Circle((0.4, 0.4), 0.2), ((-1, -1), (-0.8, -1), (-0.9, -0.5)))
    fence = Fence(keep_in=L_SHAPED, keep_out=keep_out)
    bounds = Boundaries(FOOTPRINT, fence, [MovingCircle(0, -1, 0.1, 0.2, 0.1)])
    times = rng.uniform(0, 3, 60)
    alone = [float(bounds.clearance_m(one[None], at[None])[0]) for one, at in zip(many, times, strict=True)]
    np.testing.assert_allclose(bounds.clearance_m(many, times), alone)


def test_a_line_is_followed_in_small_steps_facing_along_it():
    found = along_line(np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.03]]), 0.02)
    np.testing.assert_allclose(found[[0, -1]], [[0, 0, 0], [0.1, 0.03, math.pi / 2]], atol=1e-12)
    assert np.hypot(*np.diff(found[:, :2], axis=0).T).max() <= 0.02 + 1e-12
    assert len(found) == 6 + 3
    assert len(along_line(np.array([[0.0, 0.0], [4000.0, 0.0]]))) <= 4001
    assert along_line(np.zeros((1, 2))).shape == (0, 3)


def test_the_deepest_place_of_a_line_is_named():
    bounds = Boundaries(FOOTPRINT, Fence(keep_in=ROOM))
    assert first_breach(bounds, np.array([[0.0, 0.0, 0.0], [1.7, 0.0, 0.0]])) is None
    where = first_breach(bounds, np.array([[0.0, 0.0, 0.0], [2.0, 0.5, 0.0], [1.8, 0.0, 0.0]]))
    assert where is not None
    assert where[0] == (2.0, 0.5)
    assert where[1] == pytest.approx(0.3)
    assert first_breach(bounds, np.empty((0, 3))) is None


class Straight:
    """A task straight ahead from a start."""

    def __init__(self, start, length):
        self.start = start
        self.length = length

    def outline_m(self):
        x, y, _ = self.start
        return np.array([[x, y], [x + self.length, y]])


@pytest.mark.parametrize(
    ("start", "length", "expected_breach"),
    [
        ((-1.0, 0.0, 0.0), 2.5, None),
        ((-1.0, 0.0, 0.0), 3.0, "the task's line crosses it near (2.00, 0.00): the footprint is 0.30 m outside there"),
        ((-1.9, 0.5, 0.0), 1.0, "the task starts at (-1.90, 0.50), where the footprint is 0.10 m outside"),
    ],
)
def test_a_task_that_leaves_the_fence_is_named_with_the_place(start, length, expected_breach):
    assert task_breach(Fence(keep_in=ROOM), FOOTPRINT, Straight(start, length)) == expected_breach
    assert task_breach(Fence(), FOOTPRINT, Straight(start, length)) is None
