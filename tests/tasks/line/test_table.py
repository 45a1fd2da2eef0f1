"""Where on a path a robot begins: on the branch that its heading fits, however near the others are."""

import math

import numpy as np
import pytest

from disco_hw.tasks.lemniscate import LemniscateTask
from disco_hw.tasks.line import PathTable, planned_table
from disco_hw.tasks.path import PathTask

ANGLE = np.linspace(0.0, 2.0 * np.pi, 400)
EIGHT = PathTable(np.column_stack([1.5 * np.sin(ANGLE), 0.75 * np.sin(2.0 * ANGLE)]))
LEMNISCATE = PathTable(np.array(LemniscateTask(size_m=1.5).points()))
DRAWS = 1000


@pytest.mark.parametrize("path", [EIGHT, LEMNISCATE], ids=["eight", "lemniscate"])
def test_a_start_near_a_self_crossing_is_on_the_branch_that_the_heading_fits(path):
    rng = np.random.default_rng(7)
    count = len(path.table) - 1
    crossing = {0: 0, 1: count // 2}
    wrong = 0
    for draw in range(DRAWS):
        # Within 0.3 m of the crossing along a branch, 5 cm beside it, and 15 degrees off its direction.
        place = (crossing[draw % 2] + rng.integers(-15, 16)) % count
        x, y, along_x, along_y = path.table[place]
        clearance_m, off_rad = rng.normal(0.0, 0.05), rng.normal(0.0, math.radians(15.0))
        yaw = math.atan2(along_y, along_x) + off_rad
        found = path.place(x - clearance_m * along_y, y + clearance_m * along_x, yaw, None)
        wrong += abs(math.remainder(found - place, count)) > 30
    assert wrong == 0


def test_without_another_branch_the_nearest_place_is_taken_whatever_the_heading():
    line = PathTable(np.array([[0.0, 0.0], [2.0, 0.0]]))
    for yaw in (0.0, math.pi, -2.0, math.nan):
        assert line.place(1.0, 0.2, yaw, None) == 50.0


def test_a_branch_that_is_much_further_off_is_not_meant():
    # Up and back at 0.5 m beside: whoever stands on the first leg begins there, even facing back.
    hairpin = PathTable(np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 0.5], [0.0, 0.5]]))
    assert hairpin.place(1.0, 0.02, math.pi, None) == 50.0


@pytest.mark.parametrize("at", [(math.nan, 0.0), (0.0, math.inf)])
def test_a_place_that_is_none_is_on_the_path_all_the_same(at):
    assert 0.0 <= EIGHT.place(*at, 0.0, None) <= len(EIGHT.table)


def test_a_corner_is_drawn_in_so_that_a_place_moves_on_round_its_inside():
    path = PathTable(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]))
    corner = path.table[50, :2]
    assert np.hypot(*(corner - (1.0, 0.0))) == pytest.approx(0.02 * 0.25 * math.sqrt(2.0), rel=1e-6)
    place = 49.0
    for y_m in np.arange(0.0, 0.3, 0.02):
        at = path.table[int(place)]
        place += ((0.98 - at[0]) * at[2] + (y_m - at[1]) * at[3]) / path.spacing_m - (place - int(place))
    assert place > 60.0


@pytest.mark.parametrize(
    ("length_m", "mode", "spacing_m"),
    [(20.0, "default", 0.01), (400.0, "default", 0.01), (20.0, "sampled", 0.02), (20.0, "paper", 0.02)],
)
def test_refined_plans_follow_a_finer_table(length_m, mode, spacing_m):
    side_m = length_m / 4.0
    square = ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m), (0.0, 0.0))
    table = planned_table(square, mode)
    assert table.spacing_m == pytest.approx(spacing_m, rel=1e-3)
    corner = np.hypot(*(table.table[:, :2] - (side_m, 0.0)).T).min()
    assert corner <= 0.5 * spacing_m


def ring(gap_m, way_m):
    """A circle of 0.6 m whose last way-point is so far before the first, with so much between way-points."""
    angle = np.linspace(0.0, 2.0 * np.pi - gap_m / 0.6, round(3.8 / way_m))
    return tuple(zip(0.6 * np.sin(angle), 0.6 - 0.6 * np.cos(angle), strict=True))


@pytest.mark.parametrize("way_m", [0.05, 0.004])
@pytest.mark.parametrize("gap_m", [0.0, 0.011, 0.015, 0.019, -0.015])
def test_a_path_is_closed_whatever_its_table_if_its_ends_are_within_2_cm(gap_m, way_m):
    for mode in ("default", "sampled"):
        path = planned_table(ring(gap_m, way_m), mode)
        assert path.closed
        assert path.table[-1, :2] == pytest.approx(path.table[0, :2], abs=1e-9)
        # Round and round without a turn: where the ends meet the way goes on as everywhere.
        goes = path.table[:-1, 2:]
        assert (goes * np.roll(goes, 1, axis=0)).sum(axis=1).min() > 0.8


@pytest.mark.parametrize("mode", ["default", "sampled"])
def test_a_path_whose_ends_are_further_apart_is_open(mode):
    assert not planned_table(ring(0.021, 0.05), mode).closed


def laps_of(radius_m):
    """Three laps and a piece, all over the same ground, in one file."""
    angle = np.linspace(0.0, 6.0 * math.pi + 0.8, 250)
    return tuple(zip(radius_m * np.sin(angle), radius_m - radius_m * np.cos(angle), strict=True))


LAPS = laps_of(0.6)


@pytest.mark.parametrize("mode", ["default", "sampled"])
def test_of_laps_over_the_same_ground_the_first_is_begun(mode):
    path = planned_table(LAPS, mode)
    lap_m, rng = 1.2 * math.pi, np.random.default_rng(3)
    # At the first way-point, on the way of the last 0.5 m, and half round.
    for begun_m in (0.0, 0.4, 0.5 * lap_m):
        for _ in range(100):
            x, y = 0.6 * math.sin(begun_m / 0.6), 0.6 - 0.6 * math.cos(begun_m / 0.6)
            place = path.place(
                x + rng.normal(0.0, 0.01), y + rng.normal(0.0, 0.01), begun_m / 0.6 + rng.normal(0.0, 0.1), None
            )
            assert place * path.spacing_m == pytest.approx(begun_m, abs=0.1)


def test_a_robot_that_was_off_the_path_goes_on_with_the_lap_that_it_was_on():
    path = planned_table(laps_of(1.5), "default")
    lap = 3.0 * math.pi / path.spacing_m
    assert path.place(0.0, 0.0, 0.0, 1.6 * lap) == pytest.approx(2.0 * lap, abs=10.0)
    assert path.place(0.0, 0.0, 0.0, 2.6 * lap) == pytest.approx(3.0 * lap, abs=10.0)


def test_planner_and_progress_begin_at_the_same_place():
    task, rng = PathTask(path="laps.csv", points=LAPS), np.random.default_rng(4)
    path = task.planned("default").path
    for _ in range(50):
        x_m, y_m, yaw_rad = rng.normal(0.0, (0.1, 0.1, 0.3))
        progress = task.progress()
        progress.add(0, x_m, y_m, yaw_rad)
        assert progress.laps == path.place(x_m, y_m, yaw_rad, None) / (len(path.table) - 1)
