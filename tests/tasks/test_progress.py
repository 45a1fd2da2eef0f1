"""Progress along a path: metres behind, laps of a closed one, the end of an open one, a new count for each run."""

import math

import numpy as np
import pytest

from disco_hw.tasks.circle import CircleTask
from disco_hw.tasks.line.course import END_M
from disco_hw.tasks.path import PathTask
from disco_hw.tasks.timed_path import TimedPathTask

ANGLE = np.linspace(0.0, 2.0 * np.pi, 181)
EIGHT = tuple((1.5 * math.sin(a), 0.75 * math.sin(2.0 * a)) for a in ANGLE[:-1])
CLOSED = PathTask(path="eight.csv", points=(*EIGHT, EIGHT[0]))
LINE = PathTask(path="line.csv", points=((0.0, 0.0), (2.0, 0.0)))


def test_a_closed_path_that_crosses_itself_counts_laps_on_and_back():
    progress = CLOSED.progress()
    for a in np.linspace(0.5, 0.5 + 4.5 * np.pi, 500):
        progress.add(0, 1.5 * math.sin(a), 0.75 * math.sin(2.0 * a), math.nan)
    assert progress.laps == pytest.approx(2.25, abs=0.06)
    for a in np.linspace(0.5 + 4.5 * np.pi, 0.5 + 2.5 * np.pi, 250):
        progress.add(0, 1.5 * math.sin(a), 0.75 * math.sin(2.0 * a), math.nan)
    assert progress.laps == pytest.approx(1.25, abs=0.06)
    assert not progress.finished


def test_a_closed_path_tells_its_laps_as_a_circle_does_and_an_open_one_its_metres():
    progress = CLOSED.progress()
    for a in np.linspace(0.0, 4.5 * np.pi, 500):
        progress.add(0, 1.5 * math.sin(a), 0.75 * math.sin(2.0 * a), math.nan)
    name, text = progress.describe()
    assert name == "laps"
    assert float(text) == pytest.approx(2.25, abs=0.06)
    line = LINE.progress()
    line.add(0, 0.5, 0.0, math.nan)
    assert line.describe() == ("progress", "0.50 of 2.00 m (25%)")


def test_an_open_path_has_an_end():
    progress = LINE.progress()
    assert (progress.laps, progress.finished) == (0.0, False)
    for x_m in np.arange(0.5, 1.93, 0.02):
        progress.add(0, x_m, 0.1, math.nan)
        assert not progress.finished
    assert progress.laps == pytest.approx(0.96, abs=0.011)
    progress.add(0, 2.0 - END_M + 0.011, 0.1, math.nan)
    assert progress.finished
    progress.pause()
    assert not progress.finished
    progress.add(0, 0.1, 0.0, math.nan)
    assert (progress.laps, progress.finished) == (pytest.approx(0.05), False)


def test_a_new_run_counts_anew():
    progress = CLOSED.progress()
    for a in np.linspace(0.0, 3.0, 100):
        progress.add(0, 1.5 * math.sin(a), 0.75 * math.sin(2.0 * a), math.nan)
    assert progress.laps > 0.4
    progress.pause()
    assert progress.laps > 0.4
    progress.add(0, *EIGHT[40], math.nan)
    assert progress.laps == 0.0


def drive_round(progress, laps, steps=200):
    for angle in np.linspace(3.0, 3.0 + math.tau * laps, steps + 1):
        progress.add(0, 1.0 + math.cos(angle), -2.0 + math.sin(angle), math.nan)


@pytest.mark.parametrize("laps", [0.5, 2.25, -1.75])
def test_a_circle_counts_turns_in_both_directions(laps):
    progress = CircleTask(center_x_m=1.0, center_y_m=-2.0).progress()
    drive_round(progress, laps)
    assert (progress.laps, progress.finished) == (pytest.approx(laps), False)


def test_a_new_run_round_a_circle_starts_a_new_count_and_a_pause_keeps_the_old_one():
    progress = CircleTask(center_x_m=1.0, center_y_m=-2.0).progress()
    drive_round(progress, 1.0)
    progress.pause()
    assert progress.laps == pytest.approx(1.0)
    drive_round(progress, 0.5)
    assert progress.laps == pytest.approx(0.5)


def test_way_points_by_time_end_when_the_time_is_over_and_the_robot_is_there():
    points = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    progress = TimedPathTask(path="p.csv", points=points, times_s=(1.0, 3.0, 7.0)).progress()
    assert (progress.laps, progress.finished) == (0.0, False)
    found = []
    for second in range(9):
        progress.add((100 + second) * 10**9, 1.0, 1.0 - 0.5 * END_M, math.nan)
        found.append((progress.laps, progress.finished))
    assert [part for part, _ in found] == pytest.approx([0.0, 0.0, 0.25, 0.5, 0.625, 0.75, 0.875, 1.0, 1.0])
    assert [done for _, done in found] == [False] * 7 + [True] * 2
    progress.add(109 * 10**9, 1.0, 1.0 - 1.1 * END_M, math.nan)
    assert not progress.finished
    progress.pause()
    progress.add(200 * 10**9, 1.0, 1.0, math.nan)
    assert (progress.laps, progress.finished) == (0.0, False)
