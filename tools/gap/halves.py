"""What models learnt from one half of a measured log predict of the other, end to end: tables of `docs/results.md`.

`DISCO_HW_DATA=FOLDER python -m tools.gap.halves [--parts N | --days | --others] [--black-box] [NAME...]`: logs whose
path holds a NAME, all without one. For either half: the stage that is offered, the errors 2 s ahead on the half that
was not seen, of every stage, and how many of its 95 % intervals hold the other half's value of the same parameters, as
well as that is known, where it is known half as well. With `--parts` the same of N parts of each log, and of every
other one of it; with `--days` of whole logs, each learnt from, and every other one of the same robot predicted; with
`--others` each log predicted by all others of the robot, searched together. Where those are of windows of 2 s, 1 s
ahead. With `--black-box` also the errors of a network that knows nothing of robots (`tools.gap.black_box`), trained on
the same part.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path

# Each process works alone on one log: a second thread for its small matrices would only be in another one's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from disco_hw.effects import Stage
from disco_hw.effects.registry import in_stages
from disco_hw.gap import model_of, offered_stage, search_log, written_of
from disco_hw.gap.data import BODY, DELAYED_BY, WHEEL, Layout
from disco_hw.gap.data.gridded_drive import GriddedDrive, grid_drive
from disco_hw.gap.noise.body_noise import BodyNoise
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.search import joint_predictions
from disco_hw.gap.search.analysis import FinalFit, GapAnalysis, final_fit
from disco_hw.gap.search.channel_result import estimate_parameters
from disco_hw.gap.search.cross_validation import (
    Chain,
    PredictionErrors,
    displacement_error,
    errors_of,
    find_starts,
    scored_horizon_s,
    smoothed_poses,
    summarise,
)
from disco_hw.gap.search.evidence import Z95
from disco_hw.gap.search.unnamed_terms import with_known_terms
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.log.drive import DriveLog, concatenate
from disco_hw.log.load import load_drive
from disco_hw.model import Model
from tools.gap.black_box import BlackBox, train

# Ticks per revolution, nominal wheel radius and axial distance (m) of the robots whose logs lie in a folder.
ROBOTS = {
    "husky": (2048.0, 0.161827, 0.480865),
    "warthog": (2048.0, 0.3, 1.08),
    "optiodom": (2796.8, 0.042, 0.2),
}
STAGES = ("refitted", "timed", "amended")
BLACK_BOX = "black box"
DELAYS = ("command_delay", "motor_lag", "pose_latency")
GROUPS: dict[str, Callable[[str], bool]] = {
    "geometry": lambda name: "." not in name,
    "delays": lambda name: name.partition(".")[0] in DELAYS,
    "effects": lambda name: "." in name and name.partition(".")[0] not in DELAYS,
}


@dataclass(frozen=True)
class Half:
    """What a half of a log, or a log, taught: the stage offered, and by stage the errors 2 s ahead on another one.

    `unseen` has the errors of a black box too, where one was trained. `away`: by parameter how far that one's value
    lies from its own, in standard deviations of its interval.
    """

    learnt_from: str
    offered: str
    names: tuple[str, ...]
    unseen: dict[str, PredictionErrors]
    away: dict[str, float]
    cpu_s: float

    def ratios(self, stage: str, over: str = "timed") -> tuple[float, float]:
        """Errors of a stage over those of another, of position and of heading."""
        one, other = self.unseen[stage], self.unseen[over]
        return one.position_m / other.position_m, one.yaw_rad / other.yaw_rad

    @property
    def missed(self) -> dict[str, float]:
        """Of the parameters whose interval does not hold the other one's value, how far that is away."""
        return {name: away for name, away in self.away.items() if abs(away) > Z95}


def between(log: DriveLog, low_s: float, high_s: float) -> DriveLog:
    """The samples of a log in a span of time."""

    def cut(part):  # type: ignore[no-untyped-def]
        keep = (part.t_s >= low_s) & (part.t_s < high_s)
        columns = {each.name: getattr(part, each.name) for each in fields(part)}
        chosen = {name: value[keep] for name, value in columns.items() if isinstance(value, np.ndarray)}
        return replace(part, **chosen)

    return replace(log, commands=cut(log.commands), wheels=cut(log.wheels), poses=cut(log.poses), gyro=cut(log.gyro))


def vector(layout: Layout, model: Model) -> np.ndarray:
    """A model's parameters as a channel's vector."""
    found = layout.neutral.copy()
    for name, value in zip(model.parameter_names, model.point(), strict=True):
        if name in layout.place:
            found[layout.place[name]] = value
    return found


def channels(drive: GriddedDrive, model: Model) -> tuple[BodyChannel, WheelChannel | None, Chain]:
    """The channels of a drive, and a model in them."""
    body_vector, wheel_vector = vector(BODY, model), vector(WHEEL, model)
    known = with_known_terms(drive, model.effects, body_vector, WHEEL.at(wheel_vector, DELAYED_BY))
    body = BodyChannel.build(known, BodyNoise(), body_vector)
    wheels = WheelChannel.build(known, WheelNoise(), body_vector[:3]) if drive.has_commands else None
    return body, wheels, Chain(body_vector, None if wheels is None else wheel_vector)


def unseen_errors(
    drive: GriddedDrive, models: dict[str, Model], ahead_s: float = 2.0, box: BlackBox | None = None
) -> dict[str, PredictionErrors]:
    """Errors of models, and of a black box, on a drive, all from the same smoothed poses."""
    poses, errors = None, {}
    for stage, model in models.items():
        body, wheels, chain = channels(drive, model)
        poses = smoothed_poses(body, chain.body) if poses is None else poses
        # Of windows of 2 s nothing is known so far ahead.
        reached_s = min(ahead_s, scored_horizon_s(body, poses))
        errors[stage] = errors_of(body, wheels, {0: chain, 1: chain}, reached_s, poses)
    if box is not None and poses is not None:
        starts = find_starts(body, poses, reached_s)
        error = displacement_error(starts, box.displacement(drive, starts.node, reached_s))
        # It says nothing of the wheels.
        unknown = np.full(starts.node.size, np.nan)
        errors[BLACK_BOX] = summarise(error, unknown, starts, drive.settings.prediction)
    return errors


@dataclass(frozen=True)
class StageModels:
    """Last fit of a searched log, the table of its gap, the stage that is offered, and a model of each stage."""

    final: FinalFit
    table: dict[str, dict[float, PredictionErrors]]
    offered: str
    models: dict[str, Model]

    @classmethod
    def of(cls, analysis: GapAnalysis, nominal: Model) -> StageModels:
        """Fit the last models of a search."""
        final = final_fit(analysis)
        written = written_of(analysis, final, joint_predictions(analysis, final))
        assert written[2] is not None
        table = written[2].table()
        kept = written[0] if written[2].kept is None else written[2].kept[0]
        offered = offered_stage(table, kept.adds_to_timed, DEFAULT_SETTINGS)
        return cls(final, table, offered, {stage: model_of(stage, nominal, *written)[0] for stage in STAGES})


def black_box(drive: GriddedDrive, model: Model, ahead_s: float = 2.0) -> BlackBox:
    """A black box trained on a drive, whose poses at the starts are smoothed along the wheels' path of a model."""
    body, _, chain = channels(drive, model)
    poses = smoothed_poses(body, chain.body)
    reached_s = min(ahead_s, scored_horizon_s(body, poses))
    return train(drive, find_starts(body, poses, reached_s), poses[1], reached_s)


def values_away(analysis: GapAnalysis, final: FinalFit, other: GapAnalysis) -> dict[str, float]:
    """How far another half's value of a parameter lies from its own, in standard deviations of the interval.

    An interval says where the value is expected that another half gives, errors and all. Of the parameters that the
    other half knows at least half as well; not of how late poses of a clock are that is said to run unevenly, which is
    each log's own.
    """
    away = {}
    uneven = not (analysis.drive.pose_clock_even and other.drive.pose_clock_even)
    of_this_log = {column for effect in in_stages(Stage.POSE_TIME) if uneven for column in effect.columns}
    for found, own, there in (
        (analysis.body, final.body_estimates, other.body),
        (analysis.wheels, final.wheel_estimates, other.wheels),
    ):
        if found is None or own is None or there is None:
            continue
        selector = there.plain or there.selector
        alike = replace(there, selector=selector, names=found.names, plain=None, unnamed=())
        same = estimate_parameters(alike)
        for name, estimate in own.by_name.items():
            value = same.by_name.get(name)
            if name not in of_this_log and value is not None and value.deviation <= 2.0 * estimate.deviation:
                apart = value.value - estimate.value
                reach = estimate.high - estimate.value if apart > 0.0 else estimate.value - estimate.low
                away[name] = apart / max(reach / Z95, 1e-12)
    return away


@dataclass(frozen=True)
class Part:
    """A log or a part of one, and what the search said of it."""

    name: str
    log: DriveLog
    analysis: GapAnalysis
    cpu_s: float

    @classmethod
    def search(cls, name: str, log: DriveLog, nominal: Model) -> Part:
        """Search it."""
        began = time.process_time()
        analysis, _ = search_log(log, nominal)
        return cls(name, log, analysis, time.process_time() - began)


def read(path: Path) -> tuple[DriveLog, Model]:
    """A log, and the model of its robot as drawn."""
    ticks, radius_m, axial_m = ROBOTS[path.parent.name]
    return load_drive(path, ticks, radius_m), Model(radius_m, axial_m, 0.0)


def taught(part: Part, others: Sequence[Part], nominal: Model, boxed: bool = False) -> Iterator[Half]:
    """What a part taught of each of some others; `boxed`: a black box too."""
    began = time.process_time()
    fitted = StageModels.of(part.analysis, nominal)
    cpu_s = part.cpu_s + time.process_time() - began
    box = black_box(grid_drive(part.log), fitted.models["refitted"]) if boxed else None
    names = tuple(
        name for found in (part.analysis.wheels, part.analysis.body) if found is not None
        for name in (*found.names, *(term.form for term in found.unnamed))
    )  # fmt: skip
    for other in others:
        away = values_away(part.analysis, fitted.final, other.analysis)
        name = part.name if len(others) == 1 else f"{part.name} -> {other.name}"
        unseen = unseen_errors(grid_drive(other.log), fitted.models, box=box)
        yield Half(name, fitted.offered, names, unseen, away, cpu_s)
        cpu_s = 0.0


def halves(path: Path, count: int, boxed: bool = False) -> Iterator[Half]:
    """Each of some parts of a log, equally long, learnt from and the others predicted; none of a log without poses."""
    log, nominal = read(path)
    if not log.poses.t_s.size:
        return
    ends_s = np.linspace(float(log.wheels.t_s[0]), float(log.wheels.t_s[-1]), count + 1)
    ends_s[[0, -1]] = -np.inf, np.inf
    cuts = (between(log, *ends) for ends in pairwise(ends_s))
    parts = [Part.search(f"{path.stem} {number}", cut, nominal) for number, cut in enumerate(cuts, 1)]
    judged = [part for part in parts if part.analysis.body is not None]
    for part in judged:
        others = [other for other in judged if other is not part]
        yield from taught(part, others, nominal, boxed)


def days(paths: Sequence[Path], together: bool, boxed: bool = False) -> Iterator[Half]:
    """Each log with poses learnt from and every other one of the same robot predicted, or the other way `together`."""
    for robot in ROBOTS:
        own = [(path, *read(path)) for path in paths if path.parent.name == robot]
        own = [(path, log, nominal) for path, log, nominal in own if log.poses.t_s.size]
        parts = [Part.search(path.stem, log, nominal) for path, log, nominal in own] if len(own) > 1 else []
        for part in parts:
            others = [other for other in parts if other is not part]
            if together:
                joined = concatenate([other.log for other in others])
                yield from taught(Part.search(f"all but {part.name}", joined, own[0][2]), [part], own[0][2], boxed)
            elif part.analysis.body is not None and others:
                yield from taught(part, others, own[0][2], boxed)


def row(of: Half) -> str:
    """One line of the table: mm and mrad by stage and of the black box, and the offered one against `timed`."""
    cells = [f"{1e3 * of.unseen[stage].position_m:.1f} / {1e3 * of.unseen[stage].yaw_rad:.0f}" for stage in of.unseen]
    position, yaw = of.ratios(of.offered)
    held = f"{len(of.away) - len(of.missed)} of {len(of.away)}"
    return f"| {of.learnt_from} | {' | '.join(cells)} | {of.offered} | {position:.2f} / {yaw:.2f} | {held} |"


def against_black_box(found: Sequence[Half]) -> str:
    """How often the offered model is worse and better than the black box, and where the box is better by a fifth."""
    ratios = {half.learnt_from: half.ratios(half.offered, BLACK_BOX) for half in found}
    worse = sum(min(each) > 1.0 for each in ratios.values())
    better = sum(max(each) < 1.0 for each in ratios.values())
    # Twenty percent less than the offered model's error.
    beaten = [name for name, each in ratios.items() if max(each) > 1.0 / 0.8]
    return (
        f"offered worse than the black box in position and heading: {worse} of {len(found)}, better in both: {better}; "
        f"black box better by 20 % in one of them: {len(beaten)} ({', '.join(beaten) or 'none'})"
    )


def measured_logs(names: Sequence[str]) -> list[Path]:
    """The logs under DISCO_HW_DATA whose path holds one of the names, shortest first; all without a name."""
    folder = Path(os.environ["DISCO_HW_DATA"])
    paths = [path for robot in ROBOTS for path in (folder / robot).glob("*.csv")]
    chosen = (path for path in paths if not names or any(name in str(path) for name in names))
    return sorted(chosen, key=lambda path: path.stat().st_size)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.halves", description=(__doc__ or "").split(":")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="logs whose path holds it (all)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--parts", type=int, default=2, metavar="N", help="of each log (2)")
    what.add_argument("--days", action="store_true", help="whole logs of one robot predict each other")
    what.add_argument("--others", action="store_true", help="all others of one robot together predict each log")
    parser.add_argument("--black-box", action="store_true", help="train one on each part, which takes a minute or so")
    options = parser.parse_args(arguments)
    paths = measured_logs(options.names)
    boxed = options.black_box
    stages = (*STAGES, BLACK_BOX) if boxed else STAGES
    head = ("learnt from", f"{stages[0]}, mm / mrad", *stages[1:], "offered", "offered over timed", "intervals hold")
    print(f"| {' | '.join(head)} |")
    print(f"|{'---|' * len(head)}")
    found = []
    whole = options.days or options.others
    every = (half for path in paths for half in halves(path, options.parts, boxed))
    for half in days(paths, options.others, boxed) if whole else every:
        found.append(half)
        print(row(half), flush=True)
    worse = [half for half in found if half.offered != "timed" and max(half.ratios(half.offered)) > 1.05]
    better = [half for half in found if min(half.ratios(half.offered)) < 0.8 and max(half.ratios(half.offered)) <= 1.05]
    print(f"\noffered worse than timed by over 5 %: {len(worse)} of {len(found)}; better by 20 %: {len(better)}")
    asked, missed = sum(len(half.away) for half in found), sum(len(half.missed) for half in found)
    print(f"95 % intervals that hold the other one's value: {asked - missed} of {asked}")
    for group, of in GROUPS.items():
        inside = [abs(away) <= Z95 for half in found for name, away in half.away.items() if of(name)]
        print(f"of them {group}: {sum(inside)} of {len(inside)}")
    names = sorted(
        f"{half.learnt_from} {name} ({away:+.1f} sd)" for half in found for name, away in half.missed.items()
    )
    print(f"not: {', '.join(names)}; CPU {sum(half.cpu_s for half in found):.0f} s")
    if boxed:
        print(against_black_box(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
