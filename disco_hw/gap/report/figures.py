"""Pictures a person reads at a glance, as PNG."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.report import STAGES, reached_horizon_s
from disco_hw.gap.report.judge import regimes_of
from disco_hw.gap.report.misspecification import Regime
from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.settings import GRID_STEP_S
from disco_hw.reports import BASELINE, FLOOR, MAIN, REFERENCE, png

Array = NDArray[np.float64]

_COLOURS = {"nominal": REFERENCE, "refitted": "#9467bd", "timed": BASELINE, "amended": MAIN, "floor": FLOOR}
# Upper end of the axis of residuals, in units of the noise, at least.
_LEAST_SHOWN = 4.0
_STRETCH_S = 6.0


def pictures(analysis: GapAnalysis, gap: dict[str, dict[float, PredictionErrors]]) -> dict[str, bytes]:
    """All pictures of a report as PNG, by name."""
    out: dict[str, bytes] = {}
    if gap:
        out["gap_by_horizon"] = gap_by_horizon(gap)
        out["gap_by_regime"] = gap_by_regime(gap, reached_horizon_s(gap, analysis.drive.settings.prediction))
    for name, title, found in (
        ("command_to_wheel", "command to wheel", analysis.wheels),
        ("wheel_to_body", "wheel to body and pose sensor", analysis.body),
    ):
        if found is not None:
            out[f"where_{name}"] = disagreement(title, regimes_of(found))
    if analysis.wheels is not None:
        out["worst_stretch"] = _worst_stretch(analysis.wheels)
    return out


def _worst_stretch(wheels: ChannelResult) -> bytes:
    """Wheel speed over the six seconds in which the refitted model is furthest off."""
    channel = wheels.channel
    assert isinstance(channel, WheelChannel)
    drive = channel.drive
    angles = (channel.angles(wheels.base.vector), channel.angles(*wheels.selector.split(wheels.names)))
    before, after = (np.gradient(angle, GRID_STEP_S, axis=0) for angle in angles)
    size = np.where(np.isfinite(drive.command_rad_s[:, 0]), np.abs(before - drive.speed_rad_s).mean(axis=1), 0.0)
    width = min(round(_STRETCH_S / GRID_STEP_S), size.size)
    begin = int(np.argmax(np.convolve(size, np.ones(width), "valid")))
    part = slice(begin, begin + width)
    return stretch(drive.t_s[part], drive.speed_rad_s[part, 0], before[part, 0], after[part, 0], "left wheel, rad/s")


def _legend_outside(axes: Axes) -> None:
    """Place a legend to the right of the axes, where it covers nothing."""
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0.0, fontsize=9)


def _plain_log(axes: Axes, upward: bool) -> None:
    """Make the `upward` axis or the other one logarithmic, with plain numbers at 1, 2 and 5 of each decade."""
    (axes.set_yscale if upward else axes.set_xscale)("log")
    axis = axes.yaxis if upward else axes.xaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def gap_by_horizon(gap: dict[str, dict[float, PredictionErrors]]) -> bytes:
    """Position and heading error over the horizon, for every stage, with bootstrap intervals."""
    figure = Figure(figsize=(9.0, 3.4))
    panels: list[
        tuple[str, Callable[[PredictionErrors], float], Callable[[PredictionErrors], tuple[float, float]], float]
    ] = [
        ("position error, mm", lambda e: e.position_m, lambda e: e.position_ci, 1e3),
        ("heading error, mrad", lambda e: e.yaw_rad, lambda e: e.yaw_ci, 1e3),
    ]
    for place, (label, value, interval, factor) in enumerate(panels):
        axes = figure.add_subplot(1, 2, place + 1)
        for stage in STAGES:
            horizons = sorted(gap[stage])
            values = np.array([value(gap[stage][h]) for h in horizons]) * factor
            ends = np.array([interval(gap[stage][h]) for h in horizons]) * factor
            style = "--" if stage == "floor" else "-o"
            axes.plot(horizons, values, style, color=_COLOURS[stage], label=stage, markersize=4)
            axes.fill_between(horizons, ends[:, 0], ends[:, 1], color=_COLOURS[stage], alpha=0.15, linewidth=0)
        axes.set_xlabel("predicted ahead, s")
        axes.set_ylabel(label)
        _plain_log(axes, upward=True)
    _legend_outside(axes)
    figure.set_layout_engine("constrained")
    return png(figure)


def gap_by_regime(gap: dict[str, dict[float, PredictionErrors]], ahead_s: float) -> bytes:
    """Position error `ahead_s` ahead by what the robot was doing."""
    names = sorted(gap["refitted"][ahead_s].by_regime_m)
    figure = Figure(figsize=(9.0, 0.6 + 0.5 * max(len(names), 1)))
    axes = figure.add_subplot()
    for offset, stage in enumerate(("timed", "amended", "floor")):
        values = [1e3 * gap[stage][ahead_s].by_regime_m.get(name, 0.0) for name in names]
        rows = np.arange(len(names)) + 0.27 * (1 - offset)
        axes.barh(rows, values, height=0.25, color=_COLOURS[stage], label=stage)
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel(f"position error {ahead_s:g} s ahead, mm")
    _legend_outside(axes)
    return png(figure)


def disagreement(title: str, regimes: list[Regime]) -> bytes:
    """Residuals by regime in units of the noise, before and after what was found is added."""
    figure = Figure(figsize=(9.0, 0.6 + 0.3 * max(len(regimes), 1)))
    axes = figure.add_subplot()
    ordered = sorted(regimes, key=lambda regime: regime.before)
    rows = np.arange(len(ordered))
    before = np.sqrt([regime.before for regime in ordered])
    after = np.sqrt([regime.after for regime in ordered])
    axes.barh(rows, before, color=_COLOURS["refitted"], label="refitted")
    axes.barh(rows, after, height=0.4, color=_COLOURS["amended"], label="amended")
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_yticks(rows, [regime.name for regime in ordered])
    axes.set_xlabel("residual, in units of the noise (1 = nothing but noise)")
    axes.set_title(title, loc="left", fontsize=10)
    largest = float(before.max()) if before.size else 1.0
    if largest > 20.0:
        _plain_log(axes, upward=False)
    else:
        # Where there is nothing but noise the bars stay short, so that it looks like nothing.
        axes.set_xlim(0.0, max(1.05 * largest, _LEAST_SHOWN))
    _legend_outside(axes)
    return png(figure)


def stretch(t_s: Array, measured: Array, before: Array, after: Array, label: str) -> bytes:
    """Plot the stretch of the log in which model and measurement differ most, as a PNG image."""
    figure = Figure(figsize=(9.0, 2.8))
    axes = figure.add_subplot()
    axes.plot(t_s, measured, color="black", linewidth=1.4, label="measured")
    axes.plot(t_s, before, color=_COLOURS["refitted"], linewidth=1.1, label="refitted")
    axes.plot(t_s, after, color=_COLOURS["amended"], linewidth=1.1, label="amended")
    axes.set_xlabel("time, s")
    axes.set_ylabel(label)
    _legend_outside(axes)
    return png(figure)
