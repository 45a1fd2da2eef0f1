import numpy as np
import pytest

from disco_hw.inference.density_network import EmptyRegionError, Region

LOW, HIGH = np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.5])


def test_a_box_is_drawn_from_evenly():
    draws = Region.box(LOW, HIGH).draw(4000, np.random.default_rng(0))
    assert draws.min(axis=0) == pytest.approx(LOW, abs=0.005)
    assert draws.mean(axis=0) == pytest.approx(0.5 * (LOW + HIGH), abs=0.01)


def test_coordinates_and_points_are_inverse():
    region = Region.box(LOW, HIGH).shrunk(np.random.default_rng(0).normal([0.2, 0.1, 0.3], 0.01, (500, 3)), 4.0)
    theta = region.draw(50, np.random.default_rng(1))
    assert region.points(region.unit(theta)) == pytest.approx(theta, abs=1e-12)
    assert np.abs(region.unit(theta)).max() <= 1.0


def test_a_shrunk_region_holds_what_it_was_made_of_and_little_else():
    rng = np.random.default_rng(0)
    root = np.array([[0.01, 0.0, 0.0], [0.02, 0.001, 0.0], [0.0, 0.0, 0.005]])
    draws = np.array([0.2, 0.1, 0.3]) + rng.standard_normal((4000, 3)) @ root.T
    region = Region.box(LOW, HIGH).shrunk(draws, 4.5)
    assert region.contains(draws).mean() > 0.999
    assert region.contains(Region.box(LOW, HIGH).draw(4000, rng)).mean() < 0.01


def test_a_region_never_leaves_the_one_it_came_from():
    wide = np.random.default_rng(0).normal(0.02, 0.1, (500, 3))
    region = Region.box(LOW, HIGH).shrunk(wide, 4.5)
    draws = region.draw(500, np.random.default_rng(1))
    assert (draws >= LOW).all()
    assert (draws <= HIGH).all()


def test_a_region_outside_the_box_is_an_error_not_an_endless_search():
    away = np.random.default_rng(0).normal(5.0, 0.001, (500, 3))
    with pytest.raises(EmptyRegionError, match="empty"):
        Region.box(LOW, HIGH).shrunk(away, 4.5).draw(5, np.random.default_rng(1))
