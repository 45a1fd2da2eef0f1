"""A robot whose geometry changes on the way, driven by the daemon's core in simulated time: what adaptation wins back.

Each change is driven twice, with adaptation and without, on the same plant with the same noise; the tracking cost is
the paper's, on the plant's truth.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.guard import Geometry, believed_geometry, with_geometry
from disco_hw.effects import surface_change
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.log import records
from disco_hw.log.recorder import MemoryRecorder
from disco_hw.reports import write_pictures
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.robot_setup import Setup
from disco_hw.runtime.supervisor import UserRequest
from disco_hw.tasks.circle import CircleTask, circle_task
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

Array = NDArray[np.float64]
Progress = Callable[[str], None]

CHANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"wheel radius": (0.0, 1.0), "axial distance": (1.0, 0.0), "nothing": (0.0, 0.0)}
)
"""Names of what changes, and the shares of the change that axial distance and wheel radius take."""

BELIEVED_STD = np.array([0.002, 0.005, 0.005])
"""What `infer` leaves of x_icr (m), wheel radius and axial distance (by their size) after a drive of two minutes."""

# Chosen: poses are fused before arming, and the robot is armed before the start.
_ARM_S, _START_S = 1.5, 2.0
# Chosen: above the noise of single moments, below the time that adaptation takes.
_SMOOTH_S = 5.0


@dataclass(frozen=True, slots=True)
class AdaptOptions:
    """Options of the experiment with adaptation.

    `change` of the parameter, by its size, at `change_s`; costs are means over `compared_s` before it, and over as long
    from `settled_s` after it on. `seeds` seeds after `seed_offset` are of the plant's noise.
    """

    change: float = 0.15
    change_s: float = 60.0
    settled_s: float = 20.0
    compared_s: float = 40.0
    seeds: int = 3
    seed_offset: int = 0


@dataclass(frozen=True, eq=False, slots=True)
class AdaptRun:
    """Record of one drive.

    `t_s` (N,), instant `cost` (N,), `path` (N, 2) m of the plant; beliefs in force as (t_s, mean (3,), std (3,)).
    """

    t_s: Array
    cost: Array
    path: Array
    beliefs: tuple[tuple[float, Array, Array], ...]


@dataclass(frozen=True, eq=False, slots=True)
class AdaptResult:
    """Runs by what changed and whether the robot adapted, over the seeds."""

    options: AdaptOptions
    task: CircleTask
    runs: dict[tuple[str, bool], list[AdaptRun]]

    def rows(self) -> list[dict[str, float | str]]:
        """Return, for each change, the costs before and after it, without and with adaptation, and the share won back.

        What is lost is what the same stretch costs more than on the plant that nothing happens to: the cost varies
        along the lap. `half_back_s` is how long after the change half of it was won back over 5 s for the first time.
        """
        found: list[dict[str, float | str]] = []
        unchanged = self._mean("nothing", adapted=False, after=True)
        for name in dict.fromkeys(name for name, _ in self.runs):
            without = self._mean(name, adapted=False, after=True)
            adapted = self._mean(name, adapted=True, after=True)
            changed = any(CHANGES[name])
            found.append(
                {
                    "changes": name,
                    "cost_before": self._mean(name, adapted=False, after=False),
                    "cost_before_adapting": self._mean(name, adapted=True, after=False),
                    "cost_after": without,
                    "cost_after_adapting": adapted,
                    "won_back": (without - adapted) / (without - unchanged) if changed else math.nan,
                    "half_back_s": self._half_back_s(name) if changed else math.nan,
                    "published_s": self._published_s(name) if changed else math.nan,
                }
            )
        return found

    def table(self) -> str:
        """Return the rows and the options as text."""
        lines = [
            f"{'what changes':16s} {'before':>8s} {'(adapting)':>10s} {'after':>8s} {'adapting':>9s} {'won back':>9s} "
            f"{'published':>10s} {'half back':>10s}"
        ]
        for row in self.rows():
            lines.append(
                f"{row['changes']:16s} {row['cost_before']:8.4f} {row['cost_before_adapting']:10.4f} "
                f"{row['cost_after']:8.4f} {row['cost_after_adapting']:9.4f} {row['won_back']:9.0%} "
                f"{row['published_s']:8.1f} s {row['half_back_s']:8.1f} s"
            )
        options = ", ".join(f"{key} = {value:g}" for key, value in asdict(self.options).items())
        lines.append(f"mean tracking cost on the plant's truth, after: from settled_s after the change; {options}")
        return "\n".join(lines)

    def write_csv(self, path: Path) -> None:
        """Time, and the cost of every run."""
        named = [
            (f"{name}, {'adapting' if adapted else 'not adapting'}, seed {seed}", run)
            for (name, adapted), runs in self.runs.items()
            for seed, run in enumerate(runs, start=self.options.seed_offset + 1)
        ]
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["t_s", *(label for label, _ in named)])
            for step, t_s in enumerate(named[0][1].t_s):
                writer.writerow([f"{t_s:.3f}", *(f"{run.cost[step]:.6g}" for _, run in named)])

    def write_pictures(self, path: Path) -> None:
        """Write a PNG file, with PDF and SVG beside it, of cost and belief over time.

        The cost is smoothed and averaged over the seeds; the belief is that of the first seed.
        """
        from matplotlib.figure import Figure  # noqa: PLC0415  (slow to import, needed only here)

        names = [name for name in dict.fromkeys(name for name, _ in self.runs) if any(CHANGES[name])]
        figure = Figure(figsize=(5.5 * len(names), 7.5), layout="constrained")
        for column, name in enumerate(names):
            top, bottom = (figure.add_subplot(2, len(names), 1 + column + row * len(names)) for row in (0, 1))
            for adapted, colour in ((False, "C3"), (True, "C0")):
                runs = self.runs[name, adapted]
                label = "adapting" if adapted else "not adapting"
                top.plot(runs[0].t_s, self._smooth(name, adapted), color=colour, label=label)
            top.set(
                xlabel="time (s)",
                ylabel="tracking cost, mean of 5 s (m, with m/s)",
                title=f"{name} {self.options.change:+.0%}",
            )
            top.axvline(self.options.change_s, color="0.5", linestyle=":")
            top.legend()
            index = 1 if CHANGES[name][1] else 2
            run = self.runs[name, True][0]
            t_s = np.array([at for at, _, _ in run.beliefs] + [run.t_s[-1]])
            mean = np.array([mean[index] for _, mean, _ in run.beliefs])
            std = np.array([std[index] for _, _, std in run.beliefs])
            mean, std = np.append(mean, mean[-1]), np.append(std, std[-1])
            bottom.fill_between(t_s, mean - 2.0 * std, mean + 2.0 * std, step="post", alpha=0.3)
            bottom.step(t_s, mean, where="post", label="belief in force, 2 std")
            truth = mean[0] * np.array([1.0, 1.0, 1.0 + self.options.change, 1.0 + self.options.change])
            at_s = [0.0, self.options.change_s, self.options.change_s, run.t_s[-1]]
            bottom.plot(at_s, truth, color="k", linestyle="--", label="truth")
            bottom.set(xlabel="time (s)", ylabel=f"{name} (m)")
            bottom.legend()
        write_pictures(figure, path)

    def _mean(self, name: str, *, adapted: bool, after: bool) -> float:
        options = self.options
        begin = options.change_s + (options.settled_s if after else -options.compared_s)
        end = begin + options.compared_s
        means = [run.cost[(run.t_s >= begin) & (run.t_s < end)].mean() for run in self.runs[name, adapted]]
        return float(np.mean(means))

    def _smooth(self, name: str, adapted: bool) -> Array:
        runs = self.runs[name, adapted]
        width = round(_SMOOTH_S / (runs[0].t_s[1] - runs[0].t_s[0]))
        sums = np.cumsum(np.mean([run.cost for run in runs], axis=0))
        return np.asarray((sums - np.concatenate([np.zeros(width), sums[:-width]])) / width)

    def _half_back_s(self, name: str) -> float:
        """Inf where it never is."""
        t_s = self.runs[name, True][0].t_s - self.options.change_s
        without, adapted = self._smooth(name, adapted=False), self._smooth(name, adapted=True)
        loss = without - self._smooth("nothing", adapted=False)
        back = np.flatnonzero((t_s >= _SMOOTH_S) & (loss > 0.0) & (without - adapted >= 0.5 * loss))
        return float(t_s[back[0]]) if back.size else math.inf

    def _published_s(self, name: str) -> float:
        """Mean time from the change to the first belief after it."""
        change_s = self.options.change_s
        first = [
            min((at for at, _, _ in run.beliefs if at > change_s), default=math.inf) for run in self.runs[name, True]
        ]
        return float(np.mean(first)) - change_s


def run_adapt(
    setup: Setup, options: AdaptOptions | None = None, progress: Progress = lambda _text: None
) -> AdaptResult:
    """Drive every change with and without adaptation, over all seeds.

    `setup`: the robot; the plant is at its model's mean at first, and the belief about it as narrow as after `infer`.
    """
    options = options or AdaptOptions()
    task = circle_task(setup.config.task, "experiment adapt")
    mean = believed_geometry(setup.model).mean
    std = BELIEVED_STD * np.array([1.0, mean[1], mean[2]])
    setup = replace(setup, model=with_geometry(setup.model, Geometry(mean, np.diag(std**2))))
    runs: dict[tuple[str, bool], list[AdaptRun]] = {}
    for name in CHANGES:
        for adapted in (False, True):
            runs[name, adapted] = [
                drive(setup, _effect(name, options), options, adapted=adapted, seed=seed)
                for seed in range(options.seed_offset + 1, options.seed_offset + options.seeds + 1)
            ]
            settled_s = options.change_s + options.settled_s
            cost = np.mean([run.cost[run.t_s > settled_s].mean() for run in runs[name, adapted]])
            progress(f"{name} changes, {'adapting' if adapted else 'not adapting'}: cost afterwards {cost:.4f}")
    return AdaptResult(options, task, runs)


def _effect(name: str, options: AdaptOptions) -> dict[str, tuple[float, ...]]:
    track, radius = CHANGES[name]
    return {surface_change.EFFECT.name: (options.change * track, options.change_s + _START_S, options.change * radius)}


def drive(
    setup: Setup,
    effects: Mapping[str, tuple[float, ...]],
    options: AdaptOptions,
    *,
    adapted: bool,
    seed: int,
    recorder: MemoryRecorder | None = None,
) -> AdaptRun:
    """One drive round the circle from standstill; times count from the start of driving."""
    control = msgspec.structs.replace(setup.config.control, adaptation="fast" if adapted else "off")
    config = msgspec.structs.replace(setup.config, control=control)
    setup = replace(setup, config=config)
    task = circle_task(config.task, "experiment adapt")
    mean = believed_geometry(setup.model).mean
    plant = replace(
        PlantParameters(ticks_per_rev=round(config.robot.ticks_per_rev)),
        x_icr_m=float(mean[0]),
        wheel_radius_m=float(mean[1]),
        axial_distance_m=float(mean[2]),
    )
    start = BodyPose(*config.task_start)
    speed_m_s = -task.speed_m_s if config.turned_rad else task.speed_m_s
    run = SimulatedRun(
        setup,
        virtual_robot(setup, plant, start, effects=effects, seed=seed),
        create_planner(config, setup.model),
        recorder=recorder,
    )
    rows: list[tuple[float, float, float, float]] = []

    def drive_for(duration_s: float, *requests: UserRequest) -> None:
        for _ in run.ticks(duration_s, *requests):
            truth = run.robot.truth
            distance = math.hypot(truth.x_m - task.center_x_m, truth.y_m - task.center_y_m) - task.radius_m
            cost = math.hypot(distance, truth.speed_m_s - speed_m_s)
            rows.append((run.now_us * 1e-6 - _START_S, cost, truth.x_m, truth.y_m))

    period_s = 1.0 / config.control.rate_hz
    drive_for(_ARM_S - period_s)
    drive_for(_START_S - _ARM_S, UserRequest.ARM)
    drive_for(options.change_s + options.settled_s + options.compared_s + period_s, UserRequest.START)
    table = np.array(rows)
    table = table[table[:, 0] > 0.0]
    return AdaptRun(table[:, 0], table[:, 1], table[:, 2:], _beliefs(run.recorder, believed_geometry(setup.model)))


def _beliefs(recorder: MemoryRecorder, model: Geometry) -> tuple[tuple[float, Array, Array], ...]:
    """Return the beliefs in force over time."""
    found = [(0.0, model.mean, model.std)]
    for _, tick in recorder.ticks:
        for change in tick:
            if not isinstance(change, records.BeliefChange):
                continue
            t_s = change.t_ns * 1e-9 - _START_S
            if change.source == "model":
                found.append((t_s, model.mean, model.std))
            else:
                covariance = np.array(change.covariance).reshape(3, 3)
                found.append((t_s, np.array(change.mean), np.sqrt(np.diag(covariance))))
    return tuple(found)
