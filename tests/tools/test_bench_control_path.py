"""The figures of following a path, from drives that are known."""

import numpy as np
import pytest

from disco_hw.tasks.path import PathTask
from tools.bench.control_path import followed, paths

LINE = PathTask(path="line.csv", speed_m_s=0.25, points=((0.0, 0.0), (4.0, 0.0)))
THERE_AND_BACK = PathTask(path="back.csv", speed_m_s=0.25, points=paths()["there_and_back"])


def test_figures_of_a_drive_that_is_known():
    # Places count the entries of the table, which are 0.01 m apart.
    step = np.arange(100)
    cross_track_m = np.where(step < 20, 5.0, np.where(step < 60, 0.1, -0.2))
    rows = np.column_stack([0.02 * step, cross_track_m, np.where(step < 80, 0.2, -0.1), 2.0 * step])
    figures = followed(LINE, [rows, rows], "along")
    # The first two seconds do not count.
    assert figures["rms_mm"] == pytest.approx(np.sqrt((40 * 100.0**2 + 40 * 200.0**2) / 80.0))
    assert figures["max_mm"] == pytest.approx(200.0)
    assert figures["reverse_part"] == pytest.approx(20 / 80)
    assert figures["driven_m"] == figures["driven_least_m"] == pytest.approx(99 * 0.02)


def test_laps_of_a_closed_path_add_up():
    places = np.arange(300) * 2.0 % 400.0
    rows = np.column_stack([np.zeros((300, 2)), np.full(300, 0.2), places])
    backwards = np.column_stack([np.zeros((300, 2)), np.full(300, -0.2), places[::-1]])
    figures = followed(THERE_AND_BACK, [rows, backwards], "against")
    assert figures["driven_least_m"] == pytest.approx(-299 * 0.02)
    assert figures["driven_m"] == pytest.approx(0.0)
    assert figures["reverse_part"] == pytest.approx(0.5)


def test_the_ways_to_follow_start_at_their_first_point_and_all_but_the_lanes_are_closed():
    assert {name for name, points in paths().items() if points[0] != points[-1]} == {"lanes"}
