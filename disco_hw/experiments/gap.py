"""The loop from a missing effect to better driving, closed: hide an effect, drive, find it, add it, drive again.

Everything happens in simulated time with the daemon's own tick, driver, firmware core and log. The circle is driven by
DISCO three times: with the model as given, with its geometry refitted and nothing added, and with the amended model.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from disco_hw.config import RobotConfig
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.drive.script import ScriptSource, Unattended
from disco_hw.drive.scripts import create_script
from disco_hw.errors import InputError, WorkError
from disco_hw.experiments.circle_report import Path as Track
from disco_hw.experiments.circle_report import circle_figures
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.experiments.virtual import true_parameters
from disco_hw.gap import WRITTEN, gap
from disco_hw.gap.report import STAGES, GapReport
from disco_hw.gap.report.page import summary_lines
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import BASE_PARAMETERS
from disco_hw.reports import BASELINE, MAIN, REFERENCE, as_json, refuse_directory, write_png
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.robot_setup import Setup, load_setup
from disco_hw.tasks.circle import CircleTask, circle_task
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffectError, parse_hidden_effects
from sim.virtual_robot import RobotInProcess

RUNS = ("given", "geometry refitted", "amended")
_COLOURS = {"given": REFERENCE, "geometry refitted": BASELINE, "amended": MAIN}
# Chosen: for the way to the circle and for the first lap's beginning.
_SETTLING_S = 20.0
Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class GapExperimentOptions:
    """Options of the experiment: what to hide, how long to drive; `script` is the excitation that is recorded."""

    robot: Path
    hide: tuple[str, ...]
    out: Path
    laps: float = 1.5
    script: str = "excite"
    plant_seed: int | None = None
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Lap:
    """One drive of the circle: figures of the true path, after a quarter lap."""

    mean_cost: float
    rms_distance_m: float
    max_distance_m: float
    rms_speed_error_m_s: float


@dataclass(frozen=True)
class GapExperimentResult:
    """The effects hidden and found, the gap, and the circle with each model."""

    hidden: Mapping[str, tuple[float, ...]]
    report: GapReport
    laps: Mapping[str, Lap]
    tracks: Mapping[str, Track]
    task: CircleTask

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict."""
        return {
            "hidden": {name: list(values) for name, values in self.hidden.items()},
            "found": [effect.name for effect in self.report.effects],
            "unnamed": [term.form for term in self.report.unnamed],
            "gap_m": {stage: self.report.at_horizon(stage).position_m for stage in STAGES},
            "circle": {run: asdict(lap) for run, lap in self.laps.items()},
            "cost_removed": 1.0 - self.laps["amended"].mean_cost / self.laps["given"].mean_cost,
        }

    def as_text(self) -> str:
        """Return the result as text for a terminal."""
        lines = [
            *summary_lines(self.report),
            "",
            f"{'model':<20} {'cost':>8} {'rms d':>9} {'max d':>9} {'rms speed error':>16}",
        ]
        for run, lap in self.laps.items():
            lines.append(
                f"{run:<20} {lap.mean_cost:8.4f} {1e3 * lap.rms_distance_m:6.1f} mm {1e3 * lap.max_distance_m:6.1f} mm "
                f"{lap.rms_speed_error_m_s:12.4f} m/s"
            )
        return "\n".join(lines)

    def draw(self, path: Path) -> None:
        """Write a PNG of the circle as driven with each model, and of the distance to it over the laps."""
        figure = Figure(figsize=(10.0, 4.8), layout="constrained")
        axes = figure.subplot_mosaic([["plan", "distance"], ["plan", "speed"]])
        plan, over, speed = axes["plan"], axes["distance"], axes["speed"]
        angle = np.linspace(0.0, 2.0 * np.pi, 361)
        task = self.task
        plan.plot(
            task.center_x_m + task.radius_m * np.cos(angle), task.center_y_m + task.radius_m * np.sin(angle), "k--",
            linewidth=0.8, label="circle",
        )  # fmt: skip
        for run, track in self.tracks.items():
            away = np.hypot(track.x_m - task.center_x_m, track.y_m - task.center_y_m) - task.radius_m
            label = f"{run}: cost {self.laps[run].mean_cost:.3f}"
            plan.plot(track.x_m, track.y_m, color=_COLOURS[run], linewidth=1.3, label=label)
            over.plot(track.t_s - track.t_s[0], 1e3 * away, color=_COLOURS[run], linewidth=1.2)
            speed.plot(track.t_s - track.t_s[0], track.speed_m_s, color=_COLOURS[run], linewidth=1.2)
        plan.set_aspect("equal")
        plan.set_xlabel("x, m")
        plan.set_ylabel("y, m")
        plan.legend(frameon=False, fontsize=8, loc="center")
        hidden = ", ".join(
            f"{name} {' '.join(f'{value:g}' for value in values)}" for name, values in self.hidden.items()
        )
        figure.suptitle(f"DISCO on a robot with hidden {hidden}", fontsize=11)
        over.axhline(0.0, color="black", linewidth=0.6)
        over.set_ylabel("off the edge, mm")
        driven_m_s = np.mean(next(iter(self.tracks.values())).speed_m_s)
        speed.axhline(math.copysign(task.speed_m_s, driven_m_s), color="black", linewidth=0.6)
        speed.set_xlabel("time, s")
        speed.set_ylabel("speed, m/s")
        write_png(figure, path)


def run_gap_experiment(options: GapExperimentOptions, progress: Progress = lambda text: None) -> GapExperimentResult:
    """Hide, drive, find, add, drive again; writes table, JSON, picture, log and the gap's report to `options.out`.

    Raises InputError for wrong options, WorkError if a drive does not come to its end.
    """
    setup = load_setup(options.robot)
    task = circle_task(setup.config.task, "experiment gap")
    try:
        hidden = dict(parse_hidden_effects(options.hide).items)
    except HiddenEffectError as error:
        raise InputError(f"--hide: {error}") from None
    inputs = [options.robot, *([setup.model_file] if setup.model_file is not None else [])]
    refuse_directory(options.out, WRITTEN, inputs)
    options.out.mkdir(parents=True, exist_ok=True)
    log = options.out / "drive.mcap"
    log.unlink(missing_ok=True)
    _record(setup, options, hidden, log, progress)
    found = gap([log], options.robot, options.out, setup.model_file, progress).report
    models = {
        "given": setup.model,
        "geometry refitted": without_effects(found.model, setup.model),
        "amended": found.model,
    }
    laps, tracks = {}, {}
    for run, model in models.items():
        progress(f"circle with the model {run}")
        tracks[run] = _circle(setup, options, hidden, model)
        laps[run] = _lap(tracks[run], setup.config)
    result = GapExperimentResult(hidden, found, laps, tracks, task)
    (options.out / "experiment.json").write_text(as_json(result.as_dict(), indent=1), encoding="utf-8")
    with (options.out / "experiment.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("model", *Lap.__dataclass_fields__))
        rows.writerows((run, *asdict(lap).values()) for run, lap in laps.items())
    result.draw(options.out / "experiment.png")
    return result


def without_effects(amended: Model, given: Model) -> Model:
    """Return the amended model with the effects of the given one only, and what is believed of the rest."""
    known = {setting.name for setting in given.effects}
    effects = tuple(setting for setting in amended.effects if setting.name in known)
    names = [parameter.name for parameter in BASE_PARAMETERS]
    names += [f"{setting.name}.{key}" for setting in effects for key in setting.values]
    belief = amended.belief
    if belief is not None:
        places = [place for place, name in enumerate(belief.names) if name in names]
        chosen = tuple(belief.names[place] for place in places)
        belief = Gaussian(chosen, belief.mean()[places], belief.covariance()[np.ix_(places, places)])
    return replace(amended, effects=effects, belief=belief)


def _robot(setup: Setup, options: GapExperimentOptions, hidden: Mapping[str, tuple[float, ...]]) -> RobotInProcess:
    parameters = true_parameters(setup, options.plant_seed)
    start = BodyPose(*setup.config.task_start)
    return virtual_robot(setup, parameters, start, effects=hidden, seed=options.seed)


def _record(
    setup: Setup, options: GapExperimentOptions, hidden: Mapping[str, tuple[float, ...]], log: Path, progress: Progress
) -> None:
    """Drive the script by the daemon's core and write the log."""
    config = setup.config
    script = create_script(options.script, config.robot, config.task, config.drive.speed_share)
    pilot = HandPilot(
        ScriptSource(script, Unattended()), Coverage(config.drive.speed_share * config.robot.max_wheel_speed_rad_s)
    )
    run = SimulatedRun(setup, _robot(setup, options, hidden), NoPlanner(), pilot)
    progress(f"driving the script {options.script}, {script.duration_s:.0f} s of simulated time")
    run.drive(script.duration_s + 10.0)
    run.write_log(log)


def _circle(
    setup: Setup, options: GapExperimentOptions, hidden: Mapping[str, tuple[float, ...]], model: Model
) -> Track:
    """Return the true path of DISCO round the circle with a model."""
    task = circle_task(setup.config.task, "experiment gap")
    with_model = replace(setup, model=model)
    run = SimulatedRun(with_model, _robot(setup, options, hidden), create_planner(setup.config, model))
    run.start()
    lap_s = 2.0 * math.pi * task.radius_m / task.speed_m_s
    rows = []
    for tick in run.ticks(2.0 * options.laps * lap_s + _SETTLING_S):
        truth = run.robot.truth
        rows.append((run.now_us * 1e-6, truth.x_m, truth.y_m, truth.yaw_rad, truth.speed_m_s))
        if run.core.progress.laps >= options.laps:
            break
        if tick.command is None:
            raise WorkError(f"the virtual robot stopped on the circle: {'; '.join(tick.events)}")
    return Track(*np.array(rows).T)


def _lap(track: Track, config: RobotConfig) -> Lap:
    figures = circle_figures(track, circle_task(config.task, "experiment gap"), bool(config.turned_rad))
    return Lap(
        figures.settled_mean_cost,
        figures.settled_rms_distance_m,
        figures.settled_max_distance_m,
        figures.settled_rms_speed_error_m_s,
    )
