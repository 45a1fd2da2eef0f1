import math

import numpy as np
import pytest

from disco_hw.viewer import scene


def test_the_ellipse_holds_95_percent():
    covariance = np.array([[0.04, 0.018], [0.018, 0.01]])
    border = scene.ellipse_points(1.0, -2.0, covariance)
    offset = border - (1.0, -2.0)
    d2 = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(covariance), offset)
    draws = np.random.default_rng(1).multivariate_normal((0.0, 0.0), covariance, 20_000)
    inside = np.einsum("ni,ij,nj->n", draws, np.linalg.inv(covariance), draws) < d2.mean()
    assert np.allclose(d2, d2[0])
    assert inside.mean() == pytest.approx(0.95, abs=0.005)
    assert border[0] == pytest.approx(border[-1])


@pytest.mark.parametrize("covariance", [np.full((2, 2), np.nan), np.diag((-1.0, 1.0))])
def test_no_ellipse_of_what_is_no_covariance(covariance):
    assert scene.ellipse_points(0.0, 0.0, covariance).shape == (0, 2)


def test_segments_join_point_to_point():
    lines = scene.segments(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]), 0.5)
    assert lines.shape == (2, 2, 3)
    assert lines[0, 1].tolist() == lines[1, 0].tolist() == [1.0, 0.0, 0.5]
    assert scene.segments(np.empty((0, 2)), 0.0).shape == (0, 2, 3)


def test_the_trail_is_green_on_the_circle_and_red_far_from_it():
    on, half, far, farther = scene.distance_colours(np.array([0.0, -0.05, 0.1, 9.0]), 0.1).tolist()
    assert far == farther
    # Told apart by brightness alone, and by blue against yellow.
    assert sum(on) + 150 < sum(half) < sum(far) - 50
    assert on[2] > max(on[:2])
    assert far[2] < min(far[:2])


def test_the_body_turns_about_its_instant_centre():
    pose, speed_m_s, yaw_rate, x_icr_m, dt = (1.0, 2.0, 0.7), 0.3, 0.5, 0.2, 1e-6
    centre = scene.instant_centre(pose, speed_m_s, yaw_rate, x_icr_m, 10.0)
    # The velocity of the tracked point, from the kinematics of the model's documentation.
    lateral = -yaw_rate * x_icr_m
    moved = (
        pose[0] + dt * (speed_m_s * math.cos(0.7) - lateral * math.sin(0.7)),
        pose[1] + dt * (speed_m_s * math.sin(0.7) + lateral * math.cos(0.7)),
    )
    assert math.dist(moved, centre) == pytest.approx(math.dist(pose[:2], centre), abs=1e-10)


@pytest.mark.parametrize(("speed", "rate"), [(0.3, 0.0), (0.0, 0.0), (1.0, 0.01), (math.nan, 1.0), (1.0, math.nan)])
def test_there_is_no_centre_far_away_or_of_nothing(speed, rate):
    assert scene.instant_centre((0.0, 0.0, 0.0), speed, rate, 0.1, 5.0) is None


def test_a_wheel_rolls_forward():
    w, x, y, z = scene.about_y(math.pi / 2.0)
    assert (x, z) == (0.0, 0.0)
    # The top of the wheel, (0, 0, 1), goes to the front: R(0, 0, 1) has x = 2 w y.
    assert 2.0 * w * y == pytest.approx(1.0)
    assert scene.about_z(math.pi) == pytest.approx((0.0, 0.0, 0.0, 1.0))


def test_a_fan_is_taken_apart_into_its_paths():
    paths = scene.fan_paths((0.6, 0.4), (1.0, 2.0, 3.0, 4.0), (5.0, 6.0, 7.0, 8.0))
    assert paths.tolist() == [[[1.0, 5.0], [2.0, 6.0]], [[3.0, 7.0], [4.0, 8.0]]]


@pytest.mark.parametrize(
    ("weights", "x", "y"),
    [((), (), ()), ((1.0,), (1.0,), (1.0,)), ((0.5, 0.5), (1.0,) * 3, (1.0,) * 3), ((1.0,), (1.0, 2.0), (1.0,))],
)
def test_a_fan_that_does_not_divide_is_none(weights, x, y):
    assert scene.fan_paths(weights, x, y).shape == (0, 0, 2)


def test_weights_shade_from_the_colour_to_the_palest():
    colours = scene.weight_colours((0.5, 0.25, 0.0), (0, 100, 200), 0.2)
    assert colours[0].tolist() == [0, 100, 200]
    assert colours[2].tolist() == [204, 224, 244]
    assert (np.diff(colours.astype(int), axis=0) > 0).all()
    assert scene.weight_colours((0.0, 0.0), (0, 100, 200), 0.2).tolist() == [[204, 224, 244]] * 2
