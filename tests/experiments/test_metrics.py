"""The figures of the circle against paths whose figures are known."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments.circle_report import Path, circle_figures, estimation_figures, load_circle_report
from disco_hw.tasks.circle import CircleTask
from tools.log_samples import drive_ticks, write_log

TASK = CircleTask()


def circle(radius: float = 0.75, speed: float = 0.2, laps: float = 1.5, n: int = 3001) -> Path:
    angle = np.linspace(0.0, 2.0 * np.pi * laps, n)
    return Path(
        t_s=angle * radius / speed,
        x_m=radius * np.cos(angle),
        y_m=radius * np.sin(angle),
        yaw_rad=(angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi,
        speed_m_s=np.full(n, speed),
    )


def columns_of(path: Path) -> list[np.ndarray]:
    return [getattr(path, field.name) for field in fields(path)]


def test_the_perfect_circle_costs_nothing():
    figures = circle_figures(circle(), TASK)
    assert figures.laps == pytest.approx(1.5)
    assert figures.mean_cost == pytest.approx(0.0, abs=1e-12)


def test_a_wider_and_slower_circle_shows_both_errors():
    figures = circle_figures(circle(radius=0.85, speed=0.15), TASK)
    assert figures.rms_distance_m == pytest.approx(0.1)
    assert figures.rms_speed_error_m_s == pytest.approx(0.05)
    assert figures.mean_cost == pytest.approx(np.hypot(0.1, 0.05))


def test_a_robot_that_is_to_drive_backwards_is_too_slow_by_what_it_rolls_forwards():
    path = circle(speed=-0.15)
    assert circle_figures(path, TASK, backwards=True).rms_speed_error_m_s == pytest.approx(0.05)
    assert circle_figures(path, TASK).rms_speed_error_m_s == pytest.approx(0.35)


def test_settled_figures_leave_out_the_first_quarter_lap():
    good, start = circle(laps=1.0, n=401), circle(radius=1.75, laps=0.2, n=11)
    later = replace(good, t_s=start.t_s[-1] + 1.0 + good.t_s)
    both = [np.concatenate(columns) for columns in zip(columns_of(start), columns_of(later), strict=True)]
    figures = circle_figures(Path(*both), TASK)
    assert figures.rms_distance_m > 0.1
    assert figures.settled_rms_distance_m == pytest.approx(0.0, abs=1e-12)


def test_driving_backwards_counts_negative_laps():
    path = circle()
    assert circle_figures(replace(path, y_m=-path.y_m, yaw_rad=-path.yaw_rad), TASK).laps == pytest.approx(-1.5)


def test_estimation_error_survives_the_wrap_of_yaw_and_other_sample_times():
    truth = circle()
    some = Path(*(column[5:-5:7] for column in columns_of(truth)))
    shifted = replace(some, x_m=some.x_m + 0.03, y_m=some.y_m - 0.04, yaw_rad=some.yaw_rad + 0.01)
    figures = estimation_figures(shifted, truth)
    assert figures.rms_position_m == pytest.approx(0.05, rel=1e-6)
    assert figures.rms_yaw_rad == pytest.approx(0.01, rel=1e-6)


def test_no_common_time_is_refused():
    path = circle()
    with pytest.raises(ValueError, match="in common"):
        estimation_figures(replace(path, t_s=path.t_s + 1e6), path)


def test_a_log_that_is_continued_by_another_file_is_not_taken_for_the_whole_drive(tmp_path):
    log = tmp_path / "demo.mcap"
    write_log(log, drive_ticks(50))
    with pytest.raises(WorkError, match=r"demo\.mcap: ends before the drive did, .* drive again"):
        load_circle_report(log, tmp_path / "truth.csv", CircleTask(), 0.5, stopped=True)
