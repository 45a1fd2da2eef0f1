"""Report on a driven circle: its figures, and the log and the true motion as a table and a picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rich.table import Table

from disco_hw.errors import WorkError
from disco_hw.fence import Circle, Fence, Footprint
from disco_hw.fence.clearance import Boundaries, circle_outline
from disco_hw.log.reader import Log, open_log
from disco_hw.log.records import Counters
from disco_hw.reports import write_png
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
    """Figures of how well a path follows the circle; distances are to the circle's edge.

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


def circle_figures(path: Path, task: CircleTask, backwards: bool = False) -> CircleFigures:
    """Summarise a path around the circle; raises ValueError for a path of fewer than two samples.

    `backwards`: the robot is to drive with its back ahead.
    """
    if path.t_s.size < 2:
        raise ValueError("a path needs at least two samples")
    distance = np.abs(np.hypot(path.x_m - task.center_x_m, path.y_m - task.center_y_m) - task.radius_m)
    speed_error = (-path.speed_m_s if backwards else path.speed_m_s) - task.speed_m_s
    cost = np.hypot(distance, speed_error)
    angle = np.unwrap(np.arctan2(path.y_m - task.center_y_m, path.x_m - task.center_x_m))
    laps = (angle - angle[0]) / (2.0 * np.pi)
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


# The usual, the rare and the worst; within the tolerance a circle is complete, as it ends between two samples.
PERCENTILES = (50.0, 99.0, 99.9, 100.0)
_COMPLETED_TOLERANCE_LAPS = 0.02


@dataclass(frozen=True, slots=True)
class LoopFigures:
    """Loop period and lateness in microseconds at p50, p99, p99.9 and maximum, and what was missed.

    `stolen_ms`: as of `processes.stolen_ms`, since the daemon's start.
    """

    period_us: tuple[float, ...]
    lateness_us: tuple[float, ...]
    overruns: int
    skipped: int
    stolen_ms: int


@dataclass(frozen=True, slots=True)
class CircleReport:
    """The figures of one driven circle; `circle` is judged on the simulator's truth while the task ran."""

    task: CircleTask
    circle: CircleFigures
    estimation: EstimationFigures
    loop: LoopFigures
    frames: dict[str, int]
    laps_requested: float
    stopped: bool
    truth: Path
    estimate: Path
    pillar: Circle | None = None
    footprint: Footprint | None = None

    @property
    def left_at_pillar_m(self) -> float | None:
        """Least true distance between footprint and pillar; None without one."""
        if self.pillar is None or self.footprint is None:
            return None
        poses = np.column_stack([self.truth.x_m, self.truth.y_m, self.truth.yaw_rad])
        return float(Boundaries(self.footprint, Fence(keep_out=(self.pillar,))).clearance_m(poses).min())

    @property
    def success(self) -> bool:
        """Whether the laps were completed, no pillar was touched, and the robot stands, disarmed."""
        left = self.left_at_pillar_m
        return (
            (left is None or left > 0.0)
            and self.stopped
            and self.circle.laps >= self.laps_requested - _COMPLETED_TOLERANCE_LAPS
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as a JSON-serialisable dict."""
        return {
            "success": self.success,
            "stopped": self.stopped,
            "circle": asdict(self.circle),
            "estimation": asdict(self.estimation),
            "loop": asdict(self.loop),
            "frames": self.frames,
            **({} if self.pillar is None else {"left_at_pillar_m": self.left_at_pillar_m}),
        }

    def table(self) -> Table:
        """Return the figures as text."""
        table = Table(title=f"Circle of {self.task.radius_m} m at {self.task.speed_m_s} m/s", title_justify="left")
        table.add_column("figure")
        table.add_column("value", justify="right")
        c, e = self.circle, self.estimation
        rows = [
            ("laps driven", f"{c.laps:.2f}"),
            ("mean instant cost", f"{c.mean_cost:.4f}"),
            ("  after the first quarter lap", f"{c.settled_mean_cost:.4f}"),
            ("RMS distance to the circle", f"{c.rms_distance_m * 1e3:.1f} mm"),
            ("  after the first quarter lap", f"{c.settled_rms_distance_m * 1e3:.1f} mm"),
            ("RMS speed error", f"{c.rms_speed_error_m_s * 1e3:.1f} mm/s"),
            ("estimation error, position RMS / max", f"{e.rms_position_m * 1e3:.1f} / {e.max_position_m * 1e3:.1f} mm"),
            ("estimation error, heading RMS", f"{np.degrees(e.rms_yaw_rad):.2f} deg"),
            ("loop period p50 / p99 / p99.9 / max", _microseconds(self.loop.period_us)),
            ("loop lateness p50 / p99 / p99.9 / max", _microseconds(self.loop.lateness_us)),
            ("overruns / skipped periods", f"{self.loop.overruns} / {self.loop.skipped}"),
            ("CPU time that the machine's host took", f"{self.loop.stolen_ms} ms"),
            *((f"frames {name}", str(count)) for name, count in self.frames.items()),
            ("robot stands, disarmed", "yes" if self.stopped else "NO"),
        ]
        left = self.left_at_pillar_m
        if left is not None:
            rows.insert(
                1, ("least distance to the pillar", f"{left * 1e3:.0f} mm" + ("" if left > 0.0 else ": TOUCHED"))
            )
        for row in rows:
            table.add_row(*row)
        return table

    def draw(self, path: FilePath) -> None:
        """Write a PNG of the circle with the driven and the estimated path; needs no display."""
        figure = Figure(figsize=(6.4, 6.4), layout="constrained")
        axes = figure.add_subplot()
        angle = np.linspace(0.0, 2.0 * np.pi, 361)
        axes.plot(
            self.task.center_x_m + self.task.radius_m * np.cos(angle),
            self.task.center_y_m + self.task.radius_m * np.sin(angle),
            color="0.6", linewidth=4.0, label=f"circle, {self.task.radius_m} m",
        )  # fmt: skip
        if self.pillar is not None:
            axes.fill(*circle_outline(*self.pillar.center, self.pillar.radius_m).T, color="tab:red", label="pillar")
        axes.plot(self.truth.x_m, self.truth.y_m, color="tab:blue", linewidth=1.4, label="driven")
        axes.plot(
            self.estimate.x_m, self.estimate.y_m, color="tab:orange", linewidth=0.8, linestyle="--", label="estimated"
        )
        axes.plot(self.truth.x_m[:1], self.truth.y_m[:1], "o", color="tab:green", label="start")
        axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
        axes.set_title(
            f"{self.circle.laps:.2f} laps, mean cost {self.circle.mean_cost:.3f}; "
            f"after a quarter lap: RMS distance {self.circle.settled_rms_distance_m * 1e3:.0f} mm"
        )
        axes.grid(alpha=0.3)
        axes.legend(loc="center")
        write_png(figure, path)


def load_circle_report(
    log_file: FilePath, truth_file: FilePath, task: CircleTask, laps_requested: float, stopped: bool,
    backwards: bool = False,
) -> CircleReport:  # fmt: skip
    """Read log and truth of one run, driven `backwards` or not.

    Raises WorkError if the task never ran, or a file is not whole or does not fit.
    """
    log = open_log(log_file)
    if log.ending is None:
        raise WorkError(
            f"{log_file}: ends before the drive did, because its writer was replaced; the rest is in the other .mcap "
            "files beside it; stop other programs that write to the disk, and drive again"
        )
    command = log.columns("/command")
    driven = command["in_force"].astype(bool) & (command["source"] == "plan")
    if not driven.any():
        raise WorkError(f"{log_file}: the planner never drove; give the log of a run in which the task was started")
    first_ns, last_ns = int(command["t_ns"][driven][0]), int(command["t_ns"][driven][-1])
    truth = _between(_read_truth(truth_file), first_ns * 1e-9, last_ns * 1e-9)
    columns = log.columns("/estimate")
    estimate = _between(
        Path(
            _floats(columns["t_ns"]) * 1e-9,
            *(_floats(columns[name]) for name in ("x_m", "y_m", "yaw_rad", "speed_m_s")),
        ),
        first_ns * 1e-9,
        last_ns * 1e-9,
    )
    return CircleReport(
        task=task,
        circle=circle_figures(truth, task, backwards),
        estimation=estimation_figures(estimate, truth),
        loop=_loop_figures(log, first_ns, last_ns),
        frames=_frame_counts(log),
        laps_requested=laps_requested,
        stopped=stopped,
        truth=truth,
        estimate=estimate,
    )


def _read_truth(path: FilePath) -> Path:
    """Read the simulator's CSV (columns t_ns, x_m, y_m, yaw_rad, speed_m_s among others)."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def column(name: str) -> Array:
        return np.array([float(row[name]) for row in rows])

    if not rows:
        raise WorkError(f"{path}: no row; let `disco-hw sim --truth` write it during the drive")
    return Path(column("t_ns") * 1e-9, column("x_m"), column("y_m"), column("yaw_rad"), column("speed_m_s"))


def _between(path: Path, first_s: float, last_s: float) -> Path:
    inside = (path.t_s >= first_s) & (path.t_s <= last_s)
    return Path(path.t_s[inside], path.x_m[inside], path.y_m[inside], path.yaw_rad[inside], path.speed_m_s[inside])


def _loop_figures(log: Log, first_ns: int, last_ns: int) -> LoopFigures:
    columns = log.columns("/loop", first_ns, last_ns)
    overruns, skipped = _floats(columns["overruns"]), _floats(columns["skipped"])
    return LoopFigures(
        period_us=_percentiles(np.diff(_floats(columns["woke_ns"])) * 1e-3),
        lateness_us=_percentiles(_floats(columns["lateness_ns"]) * 1e-3),
        overruns=int(overruns[-1] - overruns[0]),
        skipped=int(skipped[-1] - skipped[0]),
        stolen_ms=_last_counters(log).loop.get("stolen_ms", 0),
    )


def _floats(values: NDArray[np.generic]) -> Array:
    return values.astype(np.float64)


def _percentiles(values: Array) -> tuple[float, ...]:
    return tuple(float(np.percentile(values, p)) for p in PERCENTILES)


def _last_counters(log: Log) -> Counters:
    counters = [entry.record for entry in log.records(("/counters",)) if isinstance(entry.record, Counters)]
    return counters[-1] if counters else Counters(0)


def _frame_counts(log: Log) -> dict[str, int]:
    last = _last_counters(log)
    if not last.transport:
        return {}
    rejected = sum(count for name, count in last.driver.items() if name.startswith("rejected"))
    return {
        "sent": last.transport["frames_sent"],
        "received": last.transport["frames_received"],
        "rejected": rejected + last.transport["malformed"],
    }


def _microseconds(values: tuple[float, ...]) -> str:
    return " / ".join(f"{value:.0f}" for value in values) + " us"


_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
# Unicode's block of braille patterns.
_BLANK = 0x2800
NARROWEST = 60
"""Columns of a terminal in which a picture still leaves room for what stands beside it."""

Point = tuple[float, float]


def picture(layers: Sequence[Iterable[Point]], low: Point, high: Point, rows: int) -> list[str]:
    """Points (x, y in metres) between two corners as lines of text, `rows` of them; x to the right, y up.

    A metre is as long upwards as it is to the right. What lies outside is left out. Raises ValueError for corners that
    hold no floor between them.
    """
    width_m, height_m = high[0] - low[0], high[1] - low[1]
    if not (width_m > 0.0 and height_m > 0.0 and rows > 0):
        raise ValueError("a picture needs corners that are apart, and a row")
    dot_m = height_m / (4 * rows)
    columns = math.ceil(width_m / (2.0 * dot_m))
    cells = [[0] * columns for _ in range(rows)]
    for points in layers:
        for x, y in points:
            if not (math.isfinite(x) and math.isfinite(y)):
                continue
            across, down = math.floor((x - low[0]) / dot_m), math.floor((high[1] - y) / dot_m)
            if 0 <= across < 2 * columns and 0 <= down < 4 * rows:
                cells[down // 4][across // 2] |= _DOTS[down % 4][across % 2]
    return ["".join(chr(_BLANK + dots) for dots in row).rstrip(chr(_BLANK)) for row in cells]


def circle_points(centre: Point, radius_m: float, count: int = 48) -> list[Point]:
    """Points around a circle, far enough apart to differ from a line."""
    turns = (2.0 * math.pi * k / count for k in range(count))
    return [(centre[0] + radius_m * math.cos(turn), centre[1] + radius_m * math.sin(turn)) for turn in turns]
