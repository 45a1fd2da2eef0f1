"""The page's plots: curves of the last seconds, and what is believed of the model's parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import viser

from disco_hw.log.records import BeliefChange
from disco_hw.model import Model
from disco_hw.tasks import RobotTask, default_task
from disco_hw.viewer import curves
from disco_hw.viewer.curves import Curves
from disco_hw.viewer.recording import ShownRobot, model_in_force
from disco_hw.viewer.timeline import Timeline

WINDOW_NS = 20_000_000_000
_HEIGHT = 170
_BLUE, _ORANGE, _GREY = "#0072b2", "#d55e00", "#777777"
_DASHES = [6, 4]
Cut = Callable[[RobotTask, Timeline, int, int], Curves]


@dataclass(frozen=True, slots=True)
class _Plot:
    handle: viser.GuiUplotHandle
    cut: Cut


class Plots:
    """Curves of the 20 s before an instant; a folder that is closed costs what an open one does, so all are drawn."""

    def __init__(self, gui: viser.GuiApi, stage: ShownRobot) -> None:
        self._model = stage.model
        self._plots: list[_Plot] = []
        self._marginals: dict[str, viser.GuiUplotHandle] = {}
        self._belief: BeliefChange | None = None
        with gui.add_folder("Plots"):
            self._add(gui, f"Distance to the {stage.task.course().noun} (m)", curves.distance)
            self._add(gui, "Speed (m/s)", curves.speed)
            self._add(gui, "Wheels (rad/s)", _any_task(curves.wheels))
            self._add(gui, "Planner", _any_task(curves.planner), ("temperature",))
        with gui.add_folder("Innovations", expand_by_default=False):
            for axis, title in (("x_m", "x (m)"), ("y_m", "y (m)"), ("yaw_rad", "yaw (rad)")):
                self._add(gui, title, _any_task(partial(curves.innovation, axis)))
        with gui.add_folder("Belief", expand_by_default=False):
            for name in stage.model.parameter_names:
                density = curves.marginals(stage.model, stage.model, name)
                if density is not None:
                    self._marginals[name] = _add_uplot(gui, name, density, ())

    def show(self, timeline: Timeline, at_ns: int, task: RobotTask, belief: BeliefChange | None) -> None:
        """Draw the curves up to an instant, with the task and the belief that are in force then."""
        for plot in self._plots:
            found = plot.cut(task, timeline, at_ns - WINDOW_NS, at_ns)
            columns = _columns(found)
            if len(columns[0]) >= 2:
                plot.handle.data = columns
        if belief is not self._belief:
            self._belief = belief
            self._show_belief(model_in_force(self._model, belief))

    def _show_belief(self, in_force: Model) -> None:
        for name, handle in self._marginals.items():
            density = curves.marginals(self._model, in_force, name)
            if density is not None:
                handle.data = _columns(density)

    def _add(self, gui: viser.GuiApi, title: str, cut: Cut, right: tuple[str, ...] = ()) -> None:
        empty = cut(default_task(), Timeline(), 0, 0)
        blank = Curves(np.array((0.0, 1.0)), {name: np.zeros(2) for name in empty.values})
        self._plots.append(_Plot(_add_uplot(gui, title, blank, right), cut))


def _any_task(cut: Callable[[Timeline, int, int], Curves]) -> Cut:
    return lambda _task, timeline, first_ns, last_ns: cut(timeline, first_ns, last_ns)


def _add_uplot(gui: viser.GuiApi, title: str, drawn: Curves, right: tuple[str, ...]) -> viser.GuiUplotHandle:
    series: list[dict[str, object]] = [{"label": "s"}]
    for number, name in enumerate(drawn.values):
        scale = {"scale": "right"} if name in right else {}
        series.append({"label": name, "width": 1.5, "spanGaps": False, **_line(name, number), **scale})
    axes: list[dict[str, object]] = [{}, {"size": 55}]
    scales: dict[str, dict[str, object]] = {"x": {"time": False}}
    if right:
        axes.append({"scale": "right", "side": 1, "size": 50, "grid": {"show": False}})
        scales["right"] = {}
    return gui.add_uplot(
        data=_columns(drawn),
        series=tuple(series),  # type: ignore[arg-type]
        title=title,
        axes=tuple(axes),  # type: ignore[arg-type]
        scales=scales,  # type: ignore[arg-type]
        legend={"show": len(drawn.values) > 1},
        height=_HEIGHT,
    )


def _line(name: str, number: int) -> dict[str, object]:
    """Colour and dashes of a curve: what is asked, allowed or believed before is dashed, the right wheel orange."""
    if name.endswith("99 %"):
        return {"stroke": _GREY, "dash": _DASHES}
    if name.endswith(("asked", "reference", "model file")):
        return {"stroke": _ORANGE if name.startswith("right") else _BLUE if "asked" in name else _GREY, "dash": _DASHES}
    return {"stroke": _ORANGE if name.startswith("right") or (number == 1 and "measured" not in name) else _BLUE}


def _columns(drawn: Curves) -> tuple[np.ndarray, ...]:
    """Times and values without the rows in which a value is missing: the page's plots do not scale with them."""
    whole = np.all(np.isfinite(np.stack(tuple(drawn.values.values()))), axis=0)
    return (drawn.t_s[whole], *(values[whole] for values in drawn.values.values()))
