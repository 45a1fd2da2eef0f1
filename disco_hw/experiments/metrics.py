"""Figures of a driven circle: cost, distance, speed, laps, estimation error. Pure functions of arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.tasks.circle import CircleTask

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Path:
    """A path over time: `t_s` (N,) increasing, `x_m`, `y_m`, `yaw_rad`, longitudinal `speed_m_s`, all (N,)."""

    t_s: Array
    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_m_s: Array


@dataclass(frozen=True, slots=True)
class CircleFigures:
    """How well a path follows the circle; distances are to the circle's edge.

    `settled_*` leave out the first quarter lap. Cost: c = sqrt(d^2 + (s - s0)^2) (paper, section V-B).
    """

    laps: float
    mean_cost: float
    settled_mean_cost: float
    rms_distance_m: float
    settled_rms_distance_m: float
    settled_max_distance_m: float
    rms_speed_error_m_s: float
    settled_rms_speed_error_m_s: float


@dataclass(frozen=True, slots=True)
class EstimationFigures:
    """Error of an estimated path against the true one."""

    rms_position_m: float
    max_position_m: float
    rms_yaw_rad: float


def turned_laps(path: Path, task: CircleTask) -> Array:
    """Signed laps around the circle's centre since the start of the path, counter-clockwise positive, shape (N,)."""
    angle = np.unwrap(np.arctan2(path.y_m - task.center_y_m, path.x_m - task.center_x_m))
    return np.asarray((angle - angle[0]) / (2.0 * np.pi), dtype=np.float64)


def circle_figures(path: Path, task: CircleTask) -> CircleFigures:
    """Summarise a path around the circle; raises ValueError for a path of fewer than two samples."""
    if path.t_s.size < 2:
        raise ValueError("a path needs at least two samples")
    distance = np.abs(np.hypot(path.x_m - task.center_x_m, path.y_m - task.center_y_m) - task.radius_m)
    speed_error = path.speed_m_s - task.speed_m_s
    cost = np.hypot(distance, speed_error)
    laps = turned_laps(path, task)
    settled = np.maximum.accumulate(laps) >= 0.25
    if not settled.any():
        settled = np.ones_like(settled)
    return CircleFigures(
        laps=float(laps[-1]),
        mean_cost=float(cost.mean()),
        settled_mean_cost=float(cost[settled].mean()),
        rms_distance_m=_rms(distance),
        settled_rms_distance_m=_rms(distance[settled]),
        settled_max_distance_m=float(distance[settled].max()),
        rms_speed_error_m_s=_rms(speed_error),
        settled_rms_speed_error_m_s=_rms(speed_error[settled]),
    )


def estimation_figures(estimate: Path, truth: Path) -> EstimationFigures:
    """Compare an estimated path with the truth, interpolated to the estimate's times inside their common span.

    Raises ValueError when the two have no time in common.
    """
    inside = (estimate.t_s >= truth.t_s[0]) & (estimate.t_s <= truth.t_s[-1])
    if not inside.any():
        raise ValueError("estimate and truth have no time in common")
    t = estimate.t_s[inside]
    error = np.hypot(
        estimate.x_m[inside] - np.interp(t, truth.t_s, truth.x_m),
        estimate.y_m[inside] - np.interp(t, truth.t_s, truth.y_m),
    )
    yaw = estimate.yaw_rad[inside] - np.interp(t, truth.t_s, np.unwrap(truth.yaw_rad))
    yaw = (yaw + np.pi) % (2.0 * np.pi) - np.pi
    return EstimationFigures(rms_position_m=_rms(error), max_position_m=float(error.max()), rms_yaw_rad=_rms(yaw))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
