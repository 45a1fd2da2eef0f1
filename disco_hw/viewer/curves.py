"""Curves over time, cut from a timeline, and the page's plots of them; the pictures draw the same curves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser
from numpy.typing import NDArray

from disco_hw.log.records import BeliefChange
from disco_hw.model import Model
from disco_hw.model.model import Belief, Gaussian, Mixture, Uniform
from disco_hw.tasks import RobotTask, default_task
from disco_hw.viewer.recording import ShownRobot, model_in_force
from disco_hw.viewer.timeline import COMMAND, ESTIMATE, INNOVATION, PLANNER, WHEELS, Series, Timeline

Array = NDArray[np.float64]
# Chosen: about the pixels of a plot's width; more would only be sent.
POINTS = 400
NORMAL_99 = 2.5758293035489004
"""Two-sided 99 % bound of a standard normal."""

# Chosen: longer hides what single ticks do.
WINDOW_NS = 20_000_000_000
# Pixels, chosen: several plots fit beside the scene.
_HEIGHT = 170
_BLUE, _ORANGE, _GREY = "#0072b2", "#d55e00", "#777777"
_DASHES = [6, 4]
_PADDING_PX = (10, 24, 0, 0)
"""Top, right, bottom, left: without the first the uppermost figure of an axis is cut off."""
_LEAST = 0.01
"""A plot about zero shows at least so much to either side, m or rad: noise below a centimetre must not fill it."""


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


def speed(task: RobotTask, timeline: Timeline, first_ns: int, last_ns: int, drives_backwards: bool = False) -> Curves:
    """Estimated speed against the task's (m/s), both negative backwards; NaN for a task without one speed."""
    t_s, rows = _window(timeline, timeline.estimate, first_ns, last_ns)
    reference = np.full(len(t_s), -task.reference_speed_m_s if drives_backwards else task.reference_speed_m_s)
    return Curves(t_s, {"speed (m/s)": rows[:, ESTIMATE.index("speed_m_s")], "reference": reference})


def wheels(timeline: Timeline, first_ns: int, last_ns: int) -> Curves:
    """Commanded and measured wheel speeds (rad/s) at the commands' ticks; zero is asked while nothing is in force."""
    t_s, commands = _window(timeline, timeline.command, first_ns, last_ns)
    sample_s, samples = _window(timeline, timeline.wheels, first_ns - 1_000_000_000, last_ns, len(timeline.wheels))
    at = np.searchsorted(sample_s, t_s, "right") - 1
    in_force = commands[:, COMMAND.index("in_force")] > 0.0
    values: dict[str, Array] = {}
    for side in ("left", "right"):
        requested = np.where(in_force, commands[:, COMMAND.index(f"{side}_rad_s")], 0.0)
        measured = np.full(len(t_s), np.nan)
        known = at >= 0
        measured[known] = samples[at[known], WHEELS.index(f"{side}_speed_rad_s")]
        values |= {f"{side} asked": requested, f"{side} measured": measured}
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


Cut = Callable[[RobotTask, Timeline, int, int], Curves]


class Plots:
    """Curves of the 20 s before an instant; a folder that is closed costs what an open one does, so all are drawn."""

    def __init__(self, gui: viser.GuiApi, stage: ShownRobot) -> None:
        self._model = stage.model
        self._plots: list[tuple[viser.GuiUplotHandle, Cut]] = []
        self._marginals: dict[str, viser.GuiUplotHandle] = {}
        self._belief: BeliefChange | None = None
        with gui.add_folder("Plots"):
            self._add(gui, f"Distance to the {stage.task.course().noun} (m)", distance, least=_LEAST)
            self._add(gui, "Speed (m/s)", partial(speed, drives_backwards=stage.drives_backwards))
            self._add(gui, "Wheels (rad/s)", _any_task(wheels))
            self._add(gui, "Planner", _any_task(planner), ("temperature",))
        with gui.add_folder("Innovations", expand_by_default=False):
            for axis, title in (("x_m", "x (m)"), ("y_m", "y (m)"), ("yaw_rad", "yaw (rad)")):
                self._add(gui, title, _any_task(partial(innovation, axis)), least=_LEAST)
        with gui.add_folder("Belief", expand_by_default=False):
            for name in stage.model.parameter_names:
                density = marginals(stage.model, stage.model, name)
                if density is not None:
                    self._marginals[name] = _add_uplot(gui, name, density, ())

    def show(self, timeline: Timeline, at_ns: int, task: RobotTask, belief: BeliefChange | None) -> None:
        """Draw the curves up to an instant, with the task and the belief that are in force then."""
        for handle, cut in self._plots:
            columns = _columns(cut(task, timeline, at_ns - WINDOW_NS, at_ns))
            if len(columns[0]) >= 2:
                handle.data = columns
        if belief is not self._belief:
            self._belief = belief
            self._show_belief(model_in_force(self._model, belief))

    def _show_belief(self, in_force: Model) -> None:
        for name, handle in self._marginals.items():
            density = marginals(self._model, in_force, name)
            if density is not None:
                handle.data = _columns(density)

    def _add(
        self, gui: viser.GuiApi, title: str, cut: Cut, right: tuple[str, ...] = (), least: float | None = None
    ) -> None:
        empty = cut(default_task(), Timeline(), 0, 0)
        blank = Curves(np.array((0.0, 1.0)), {name: np.zeros(2) for name in empty.values})
        self._plots.append((_add_uplot(gui, title, blank, right, least), cut))


def _any_task(cut: Callable[[Timeline, int, int], Curves]) -> Cut:
    return lambda _task, timeline, first_ns, last_ns: cut(timeline, first_ns, last_ns)


def _add_uplot(
    gui: viser.GuiApi, title: str, curves: Curves, right: tuple[str, ...], least: float | None = None
) -> viser.GuiUplotHandle:
    series: list[dict[str, object]] = [{"label": "s"}]
    for number, name in enumerate(curves.values):
        scale = {"scale": "right"} if name in right else {}
        series.append({"label": name, "width": 1.5, "spanGaps": False, **_line(name, number), **scale})
    axes: list[dict[str, object]] = [{}, {"size": 55}]
    scales: dict[str, dict[str, object]] = {"x": {"time": False}}
    if least is not None:
        # The plot's mode 1: the limit counts unless a value lies beyond it.
        ends = {name: {"pad": 0.1, "soft": way * least, "mode": 1} for name, way in (("min", -1.0), ("max", 1.0))}
        scales["y"] = {"range": ends}
    if right:
        axes.append({"scale": "right", "side": 1, "size": 50, "grid": {"show": False}})
        scales["right"] = {}
    return gui.add_uplot(
        data=_columns(curves),
        series=tuple(series),  # type: ignore[arg-type]
        title=title,
        axes=tuple(axes),  # type: ignore[arg-type]
        scales=scales,  # type: ignore[arg-type]
        legend={"show": len(curves.values) > 1},
        height=_HEIGHT,
        padding=_PADDING_PX,
    )


def _line(name: str, number: int) -> dict[str, object]:
    """Colour and dashes of a curve: what is asked, allowed or believed before is dashed, the right wheel orange."""
    if name.endswith("99 %"):
        return {"stroke": _GREY, "dash": _DASHES}
    if name.endswith(("asked", "reference", "model file")):
        return {"stroke": _ORANGE if name.startswith("right") else _BLUE if "asked" in name else _GREY, "dash": _DASHES}
    return {"stroke": _ORANGE if name.startswith("right") or (number == 1 and "measured" not in name) else _BLUE}


def _columns(curves: Curves) -> tuple[np.ndarray, ...]:
    """Return times and values without the rows in which a value is missing: the page's plots do not scale with them."""
    is_complete = np.all(np.isfinite(np.stack(tuple(curves.values.values()))), axis=0)
    return (curves.t_s[is_complete], *(values[is_complete] for values in curves.values.values()))
