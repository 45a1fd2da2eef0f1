"""Tuning set and validation set of the search for missing effects, and what the search finds in one of their logs.

Choices of thresholds and rules look at the tuning set alone. Seeds of its simulated and MuJoCo logs are 31 and 32, of
the validation set 131 and 132. Real logs are divided by robot and day, and each is searched by halves. Real logs need
the folder `DISCO_HW_DATA`; without it both sets have none.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tools.gap.jobs import Job, jobs, judged  # first: it sets the threads of the linear algebra

# isort: split
import numpy as np

from disco_hw.gap import find_gap
from disco_hw.gap.report import GapReport
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from disco_hw.log.drive import DriveLog
from disco_hw.model import Model
from tools.gap.halves import between, read
from tools.gap.jobs import MODEL, log_of
from tools.gap.logs import LARGEST_RAD_S
from tools.gap.mujoco import NAMES, truth_of
from tools.mujoco_robot import ROBOTS, record

TUNING, VALIDATION = 31, 131
SINGLE = ("pose_latency", "speed_limit", "stiction", "surface_change")
IN_MUJOCO = ("dry_friction", "payload")
# Real logs of either set, and which halves: Husky and Warthog by floor and day, the small robot by day.
REAL: Mapping[int, tuple[tuple[str, tuple[int, ...]], ...]] = {
    TUNING: (
        ("husky/husky_tile_deflated_20231212", (1,)),
        ("warthog/warthog_grass_20240718_a", (1, 2)),
        ("optiodom/free_20210103_0006_run01", (1, 2)),
        ("optiodom/square_20200623_2042_run01", (1,)),
    ),
    VALIDATION: (
        ("warthog/warthog_asphalt_20240920_0813", (1, 2)),
        ("optiodom/square_20201223_0029_run01", (1,)),
        ("optiodom/free_20210102_2354_run01", (1, 2)),
    ),
}


@dataclass(frozen=True)
class Found:
    """What the search found in a log.

    `right`: whether the truth was named, None where it is not known. `over_timed`: errors of the offered model over
    those of `timed` on held-out data, of position and heading. `held`: whether each 95 % interval holds the truth.
    `answer`: names, doubts and values to three digits.
    """

    right: bool | None
    over_timed: tuple[float, float]
    held: list[bool]
    answer: dict[str, Any]
    cpu_s: float


@dataclass(frozen=True)
class TuningLog:
    """One log of a set: a simulated job, a drive in MuJoCo, or a half of a real log."""

    key: str
    job: Job | None = None
    hidden: str = ""
    seed: int = 0
    half: int = 0

    def search(self, settings: GapSettings = DEFAULT_SETTINGS) -> Found:
        """Search the log, and compare what is found with what is known."""
        if self.job is not None:
            log, model, top_rad_s = log_of(self.job), MODEL, LARGEST_RAD_S
        elif self.hidden:
            robot = ROBOTS["middle"]
            recording = record({self.hidden: robot.size(self.hidden)}, self.seed, robot=robot)
            log, model, top_rad_s = recording.as_drive(), Model(robot.wheel_radius_m, robot.track_m, 0.0), None
        else:
            (log, model), top_rad_s = self._half(), None
        began = time.process_time()
        report = find_gap(log, model, top_rad_s=top_rad_s, settings=settings)
        cpu_s = time.process_time() - began
        named = {effect.name: effect.parameters for effect in report.effects}
        right, held = None, []
        if self.job is not None:
            right = set(named) - ({"motor_lag"} - set(self.job.hidden)) == set(self.job.hidden) and not report.unnamed
            for name in set(self.job.hidden) & set(named):
                held += judged(name, self.job.hidden[name], named[name])[1]
        elif self.hidden:
            effect, parameter = NAMES[self.hidden]
            truth = truth_of(self.hidden, recording, [term.form for term in report.unnamed])
            value = named[effect][parameter] if effect in named else None
            right = value is not None and truth is not None and abs(value.value / truth - 1.0) <= 0.1
            held = [] if value is None or truth is None else [value.low <= truth <= value.high]
        return Found(right, _over_timed(report), held, _answer(report), cpu_s)

    def _half(self) -> tuple[DriveLog, Model]:
        log, model = read(Path(os.environ["DISCO_HW_DATA"]) / f"{self.key.rpartition('#')[0]}.csv")
        begin_s, end_s = float(log.wheels.t_s[0]), float(log.wheels.t_s[-1])
        middle_s = 0.5 * (begin_s + end_s)
        return between(log, *((-np.inf, middle_s) if self.half == 1 else (middle_s, np.inf))), model


def tuning_logs(first_seed: int) -> list[TuningLog]:
    """List the logs of a set, kinds mixed, so that the first few are a fair sample."""
    seeds = (first_seed,)
    single = {next(iter(job.hidden)): job for job in jobs("single", seeds)}
    simulated = [
        *(single[name] for name in SINGLE), *jobs("none", seeds), *jobs("dirty", seeds),
        *jobs("pairs", (first_seed, first_seed + 1)),
    ]  # fmt: skip
    groups = [
        [TuningLog(job.key, job=job) for job in simulated],
        [TuningLog(f"mujoco-{name}", hidden=name, seed=first_seed + k) for k, name in enumerate(IN_MUJOCO)],
    ]
    if "DISCO_HW_DATA" in os.environ:
        groups.append([TuningLog(f"{name}#{half}", half=half) for name, each in REAL[first_seed] for half in each])
    # Each group spread evenly over the whole, but the long logs of heavy robots last.
    places = [
        (log.key.startswith(("husky", "warthog")), (place + 0.5) / len(group), log.key, log)
        for group in groups for place, log in enumerate(group)
    ]  # fmt: skip
    return [log for *_, log in sorted(places, key=lambda each: each[:3])]


def _over_timed(report: GapReport) -> tuple[float, float]:
    """Return the errors of the offered model over those of `timed`; nothing to compare counts as alike."""
    if not report.gap:
        return 1.0, 1.0
    handed_out = "written" if report.offered == "amended" and "written" in report.gap else report.offered
    one, timed = (report.at_horizon(stage) for stage in (handed_out, "timed"))
    return one.position_m / timed.position_m, one.yaw_rad / timed.yaw_rad


def _answer(report: GapReport) -> dict[str, Any]:
    return {
        "named": sorted(effect.name for effect in report.effects),
        "unnamed": sorted(term.form.split(" ", 3)[-1] for term in report.unnamed),
        "doubtful": sorted(doubt.name for doubt in report.doubtful),
        "blind": sorted(spot.name for spot in report.blind_spots if spot.blind),
        "alike": sorted({name for effect in report.effects for name in effect.indistinguishable_from}),
        "residue": len(report.residue),
        "remains": report.remains is not None,
        "offered": report.offered,
        "values": {
            f"{effect.name}.{key}": [float(f"{number:.3g}") for number in (each.value, each.low, each.high)]
            for effect in report.effects for key, each in effect.parameters.items()
        },
    }  # fmt: skip
