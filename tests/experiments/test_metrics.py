"""The figures of the circle against paths whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from disco_hw.experiments.circle_report import Path, circle_figures, estimation_figures
from disco_hw.tasks.circle import CircleTask

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


def test_the_perfect_circle_costs_nothing():
    figures = circle_figures(circle(), TASK)
    assert figures.laps == pytest.approx(1.5)
    assert figures.mean_cost == pytest.approx(0.0, abs=1e-12)


def test_a_wider_and_slower_circle_shows_both_errors():
    figures = circle_figures(circle(radius=0.85, speed=0.15), TASK)
    assert figures.rms_distance_m == pytest.approx(0.1)
    assert figures.rms_speed_error_m_s == pytest.approx(0.05)
    assert figures.mean_cost == pytest.approx(np.hypot(0.1, 0.05))


def test_settled_figures_leave_out_the_first_quarter_lap():
    good, start = circle(laps=1.0, n=401), circle(radius=1.75, laps=0.2, n=11)
    both = Path(
        t_s=np.concatenate([start.t_s, start.t_s[-1] + 1.0 + good.t_s]),
        x_m=np.concatenate([start.x_m, good.x_m]),
        y_m=np.concatenate([start.y_m, good.y_m]),
        yaw_rad=np.concatenate([start.yaw_rad, good.yaw_rad]),
        speed_m_s=np.concatenate([start.speed_m_s, good.speed_m_s]),
    )
    figures = circle_figures(both, TASK)
    assert figures.rms_distance_m > 0.1
    assert figures.settled_rms_distance_m == pytest.approx(0.0, abs=1e-12)


def test_driving_backwards_counts_negative_laps():
    path = circle()
    mirrored = Path(path.t_s, path.x_m, -path.y_m, -path.yaw_rad, path.speed_m_s)
    assert circle_figures(mirrored, TASK).laps == pytest.approx(-1.5)


def test_estimation_error_survives_the_wrap_of_yaw_and_other_sample_times():
    truth = circle()
    shifted = Path(
        truth.t_s[5:-5:7],
        truth.x_m[5:-5:7] + 0.03,
        truth.y_m[5:-5:7] - 0.04,
        truth.yaw_rad[5:-5:7] + 0.01,
        truth.speed_m_s[5:-5:7],
    )
    figures = estimation_figures(shifted, truth)
    assert figures.rms_position_m == pytest.approx(0.05, rel=1e-6)
    assert figures.rms_yaw_rad == pytest.approx(0.01, rel=1e-6)


def test_no_common_time_is_refused():
    path = circle()
    shifted = Path(path.t_s + 1e6, path.x_m, path.y_m, path.yaw_rad, path.speed_m_s)
    with pytest.raises(ValueError, match="in common"):
        estimation_figures(shifted, path)
