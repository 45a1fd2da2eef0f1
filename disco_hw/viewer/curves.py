"""Curves over time, cut from a timeline: what the page plots and the pictures show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.model import Model
from disco_hw.model.belief import Belief, Gaussian, Mixture, Uniform
from disco_hw.tasks import RobotTask
from disco_hw.viewer.timeline import COMMAND, ESTIMATE, INNOVATION, PLANNER, WHEELS, Series, Timeline

Array = NDArray[np.float64]
POINTS = 400
NORMAL_99 = 2.5758293035489004
"""Two-sided 99 % bound of a standard normal."""


@dataclass(frozen=True, eq=False, slots=True)
class Curves:
    """Values (N,) by name over seconds `t_s` (N,)."""

    t_s: Array
    values: dict[str, Array]


def distance(task: RobotTask, timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Distance to the task's line (m), positive to the right of it: outside of a circle."""
    t_s, rows = _window(timeline, timeline.estimate, first_ns, last_ns)
    away = task.course().off_m(rows[:, :2])
    away[rows[:, ESTIMATE.index("pose_healthy")] == 0.0] = np.nan
    return Curves(t_s, {"distance (m)": away})


def speed(task: RobotTask, timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Estimated speed against the task's (m/s); NaN for a task without one speed."""
    t_s, rows = _window(timeline, timeline.estimate, first_ns, last_ns)
    reference = np.full(len(t_s), task.reference_speed_m_s)
    return Curves(t_s, {"speed (m/s)": rows[:, ESTIMATE.index("speed_m_s")], "reference": reference})


def wheels(timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Commanded and measured wheel speeds (rad/s) at the commands' ticks; zero is asked while nothing is in force."""
    t_s, commands = _window(timeline, timeline.command, first_ns, last_ns)
    sample_s, samples = _window(timeline, timeline.wheels, first_ns - 1_000_000_000, last_ns, len(timeline.wheels))
    at = np.searchsorted(sample_s, t_s, "right") - 1
    in_force = commands[:, COMMAND.index("in_force")] > 0.0
    values: dict[str, Array] = {}
    for side in ("left", "right"):
        asked = np.where(in_force, commands[:, COMMAND.index(f"{side}_rad_s")], 0.0)
        measured = np.full(len(t_s), np.nan)
        known = at >= 0
        measured[known] = samples[at[known], WHEELS.index(f"{side}_speed_rad_s")]
        values |= {f"{side} asked": asked, f"{side} measured": measured}
    return Curves(t_s, values)


def planner(timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Effective sample size and temperature of each plan."""
    t_s, rows = _window(timeline, timeline.planner, first_ns, last_ns)
    return Curves(
        t_s,
        {
            "effective samples": rows[:, PLANNER.index("effective_samples")],
            "temperature": rows[:, PLANNER.index("temperature")],
        },
    )


def innovation(axis: str, timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Innovation of one of x_m, y_m, yaw_rad with its 99 % bounds."""
    t_s, rows = _window(timeline, timeline.innovation, first_ns, last_ns)
    variance = rows[:, INNOVATION.index(f"variance_{axis.split('_', maxsplit=1)[0]}")]
    bound = NORMAL_99 * np.sqrt(np.maximum(variance, 0.0))
    return Curves(t_s, {axis: rows[:, INNOVATION.index(axis)], "+99 %": bound, "-99 %": -bound})


def marginals(file: Model, in_force: Model, name: str, count: int = 160) -> Curves | None:
    """Densities of one believed parameter over its values (in `t_s`), within 4 standard deviations; None if exact.

    Of the model file, and of the belief in force, which is another one after it was adapted.
    """
    beliefs = {"model file": file.belief, "in force": in_force.belief}
    spans = []
    for belief in beliefs.values():
        if belief is None or name not in belief.names:
            return None
        index = belief.names.index(name)
        mean, std = belief.mean()[index], float(np.sqrt(belief.covariance()[index, index]))
        spans += [mean - 4.0 * std, mean + 4.0 * std]
    x = np.linspace(min(spans), max(spans), count)
    return Curves(x, {label: _density(belief, name, x) for label, belief in beliefs.items() if belief is not None})


def _density(belief: Belief, name: str, x: Array) -> Array:
    index = belief.names.index(name)
    match belief:
        case Gaussian():
            return _normal(x, belief.means[index], belief.covariances[index, index])
        case Mixture():
            density = np.zeros(len(x))
            for weight, part in zip(belief.weights, belief.components, strict=True):
                density += weight * _normal(x, part.means[index], part.covariances[index, index])
            return density
        case Uniform():
            inside = (x >= belief.low[index]) & (x <= belief.high[index])
            return np.asarray(inside / (belief.high[index] - belief.low[index]))
        case _:
            return np.full(len(x), np.nan)


def _normal(x: Array, mean: float, variance: float) -> Array:
    return np.asarray(np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance))


def _window(
    timeline: Timeline, series: Series, first_ns: int, last_ns: int, count: int = POINTS
) -> tuple[Array, Array]:
    """Seconds since the run's start and rows of a series between two times, at most about `count`, evenly picked."""
    times, rows = series.rows(first_ns, last_ns)
    step = max(1, -(-len(times) // max(count, 1)))
    origin = timeline.first_ns or 0
    return np.asarray((times[::step] - origin) * 1e-9, np.float64), rows[::step].copy()
