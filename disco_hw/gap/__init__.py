"""Analysis of the gap between simulation and data: the missing effect, the amended model, the gap that is left.

This module has the analysis as one call, from logs and a model to the report, and the command `disco-hw gap`.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import Robot, load_robot_config, model_file_of
from disco_hw.errors import LogError, WorkError
from disco_hw.gap.data import BASE_COUNT, BODY, DELAYED_BY, WHEEL, Layout
from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.report import FleetResult, FleetRow, GapReport, Provenance, handed_out, reached_horizon_s
from disco_hw.gap.report.amend import amended_model, at_joint_fit, carried_terms, channel_estimates, simple_model
from disco_hw.gap.report.blind_spots import being_proved, boldest_claims, finder
from disco_hw.gap.report.events import main_event, rare_events
from disco_hw.gap.report.judge import (
    Measured,
    across_logs,
    blind_spot_findings,
    candidate_evidence,
    channel_findings,
    classify_findings,
    drifting_parameters,
    effect_findings,
    left_out_notes,
    residue_sentences,
    unnamed_findings,
)
from disco_hw.gap.report.page import as_text, page
from disco_hw.gap.report.remains import Remains
from disco_hw.gap.search import StagePredictions, joint_predictions, stage_predictions
from disco_hw.gap.search.analysis import FinalFit, GapAnalysis, final_fit
from disco_hw.gap.search.channel_result import ChannelEstimates
from disco_hw.gap.search.channel_search import search_body, search_wheels, that_models_hold
from disco_hw.gap.search.cross_validation import PredictionErrors, only_timed, wheel_table, worse_by
from disco_hw.gap.search.decision import first_as_good
from disco_hw.gap.search.richest_model import DELAY_COLUMNS, candidates_of
from disco_hw.gap.search.unnamed_terms import with_known_terms
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from disco_hw.log import version
from disco_hw.log.consistency import find_contradictions, refuse_contradictions
from disco_hw.log.drive import DriveLog, concatenate
from disco_hw.log.load import load_drive
from disco_hw.model import Model, load_model, save_model
from disco_hw.reports import as_json, refuse_directory

__all__ = ["GapReport", "find_gap"]


Array = NDArray[np.float64]
Progress = Callable[[str], None]


def find_gap(
    logs: DriveLog | Sequence[DriveLog],
    model: Model,
    progress: Progress | None = None,
    pictures: bool = False,
    prove: bool = False,
    top_rad_s: float | None = None,
    settings: GapSettings = DEFAULT_SETTINGS,
) -> GapReport:
    """Find where logs and model disagree, name what is missing, amend the model and show the gap shrink.

    `logs`: one drive or several of one robot. `model`: nominal geometry, with the effects that are known already;
    those are refitted, not reported. `progress` hears what is being done; `pictures` draws them too; `prove` puts
    effects into the log to see whether those it is said to show are found. `top_rad_s`: the robot's largest wheel
    speed, without which it is not known to which speed limits the logs are blind. `settings`: all thresholds. Raises
    LogError if the logs hold too little to judge either channel.
    """
    began = time.perf_counter()
    report_progress = progress or (lambda text: None)
    log = logs if isinstance(logs, DriveLog) else concatenate(logs)
    warnings = check_consistency(log, model)
    analysis, notes = search_log(log, model, report_progress, settings)
    report_progress("intervals, blind spots and the gap on held-out data")
    final = final_fit(analysis)
    named, unnamed = effect_findings(analysis, final), unnamed_findings(analysis)
    effects, doubtful = classify_findings(named, Measured.of(analysis, final))
    spots = blind_spot_findings(analysis, named, top_rad_s)
    claims = boldest_claims(spots, settings.report.proved_claims) if prove else ()
    if claims:
        report_progress(
            f"proof of what this log shows: {', '.join(claim.name for claim in claims)} put in and searched for"
        )
    with being_proved(spots, claims, finder(analysis)) as proved:
        predictions = joint_predictions(analysis, final) if analysis.body is not None else None
        gap = {} if predictions is None else predictions.table()
        wheels = wheel_table(analysis)
        written = written_of(analysis, final, predictions)
        if written[0] is not analysis:
            if gap and written[2] is not None:
                gap["written"] = written[2].table()["amended"]
            if wheels:
                wheels = {**wheels, "written": wheel_table(written[0])["amended"]}
        images = _draw_images(analysis, gap) if pictures else {}
        spots = proved()
    # Without poses the wheels decide, where geometry says nothing: as given, timed or amended.
    kept = written[0] if written[2] is None or written[2].kept is None else written[2].kept[0]
    offered = offered_stage(gap or _of_wheels(wheels), kept.adds_to_timed, settings)
    amended, remarks = model_of(offered, model, *written)
    remains, events = None, rare_events(analysis.channels, log.sources, log.begins_s)
    if gap and written[2] is not None:
        ahead_s = reached_horizon_s(gap, settings.prediction)
        timed, left, noise = (gap[stage][ahead_s] for stage in ("timed", handed_out(offered, gap), "floor"))
        remains = Remains.of(timed, left, noise, written[2].errors_of_body(offered))
        if remains is not None:
            remains = replace(remains, event=main_event(events, remains.channel))
    remarks = (*left_out_notes(written[0], written[1], kept), *remarks)
    return GapReport(
        sources=log.sources,
        channels=channel_findings(analysis, named, unnamed),
        effects=effects,
        unnamed=unnamed,
        blind_spots=spots,
        gap=gap,
        model=amended,
        offered=offered,
        residue=(*residue_sentences(analysis), *drifting_parameters(analysis, final)),
        doubtful=doubtful,
        notes=(*log.notes, *analysis.drive.notes, *notes, *remarks),
        candidates=candidate_evidence(analysis),
        pictures=images,
        seconds=time.perf_counter() - began,
        settings=settings,
        wheels=wheels,
        across=across_logs(analysis),
        warnings=warnings,
        remains=remains,
        events=events,
    )


def check_consistency(log: DriveLog, model: Model) -> tuple[str, ...]:
    """Warnings of what contradicts itself in a log; raises LogError where nothing can be concluded from it."""
    return refuse_contradictions(
        find_contradictions(log, model.wheel_radius_m, model.axial_distance_m), ("body", "response")
    )


def written_of(
    analysis: GapAnalysis, final: FinalFit, predictions: StagePredictions | None
) -> tuple[GapAnalysis, FinalFit, StagePredictions | None]:
    """Return the analysis to write the model from: refitted without the terms that no model can hold."""
    written = analysis
    if analysis.body is not None and (body := that_models_hold(analysis.body)) is not analysis.body:
        written = replace(written, body=body)
    if analysis.wheels is not None and (refitted := that_models_hold(analysis.wheels)) is not analysis.wheels:
        written = replace(written, wheels=refitted)
    if written is analysis:
        return analysis, final, predictions
    final = final_fit(written)
    return written, final, joint_predictions(written, final) if written.body is not None else None


def _of_wheels(wheels: Mapping[str, Mapping[float, PredictionErrors]]) -> dict[str, Mapping[float, PredictionErrors]]:
    return {**wheels, "refitted": wheels["nominal"]} if wheels else {}


def offered_stage(gap: Mapping[str, Mapping[float, PredictionErrors]], adds: bool, settings: GapSettings) -> str:
    """Return the stage whose model is offered: the first that is as good as the best, by the rule of `decision`.

    First comes `timed`, as every robot is late; but where the amended model `adds` nothing to a delay and a lag, that
    does. The amended one counts as it is `written`, where it lacks what no model can carry, and is handed out where
    predictions cannot be compared.
    """
    horizon_s = reached_horizon_s(gap, settings.prediction)
    if not gap or not math.isfinite(gap["amended"][horizon_s].position_m):
        return "amended"
    errors = {stage: gap[stage][horizon_s] for stage in ("timed", "refitted")}
    errors["amended"] = gap.get("written", gap["amended"])[horizon_s]
    floor = gap["floor"][horizon_s] if "floor" in gap else None
    order = ("timed", "refitted", "amended") if adds else ("amended", "timed", "refitted")
    return first_as_good(order, errors.__getitem__, floor, settings.report.worth_share)


def model_of(
    stage: str, model: Model, analysis: GapAnalysis, final: FinalFit, predictions: StagePredictions | None
) -> tuple[Model, tuple[str, ...]]:
    """Return the model of a stage, and notes on it; a fitted model has the joint Gaussian of its parameters."""
    if predictions is not None and stage != "amended":
        return simple_model(model, *predictions.joint[stage])
    if analysis.body is None and analysis.wheels is not None and stage != "amended":
        if stage == "refitted":
            return model, ()
        timed = replace(analysis, wheels=only_timed(analysis.wheels))
        return model_of("amended", model, timed, final_fit(timed), None)
    if predictions is not None:
        of, joint = predictions.joint["amended"]
        analysis, final = predictions.kept or (analysis, final)

        def moved(part: ChannelEstimates | None, channel: int) -> ChannelEstimates | None:
            return None if part is None else at_joint_fit(part, of.parts[channel], of, joint)

        final = replace(
            final,
            body_estimates=moved(final.body_estimates, 0),
            wheel_estimates=moved(final.wheel_estimates, 1),
            final_body_estimates=moved(final.final_body_estimates, 0),
            final_body=None if final.final_body is None else replace(final.final_body, vector=joint.vectors[0]),
        )
    named = {effect.name: effect.parameters for effect in effect_findings(analysis, final, given=True)}
    if final.wheel_estimates is not None:
        values = final.wheel_estimates.by_name
        for column in DELAY_COLUMNS:
            name, _, key = column.partition(".")
            if name not in named and column in values:
                named[name] = {key: values[column]}
    return amended_model(model, named, carried_terms(analysis, final), channel_estimates(analysis, final))


def _draw_images(analysis: GapAnalysis, gap: dict[str, dict[float, PredictionErrors]]) -> dict[str, bytes]:
    from disco_hw.gap.report import figures  # noqa: PLC0415  (matplotlib, slow to import)

    return figures.pictures(analysis, gap)


def missing_effects(log: DriveLog, model: Model) -> tuple[str, ...]:
    """Only the names of what a log shows and a model lacks, the surest first; raises as `find_gap`.

    Doubtful ones only where all are: something is missing then too. None where poses are predicted as well without
    them, from commands and with the geometry refitted: a log of two minutes shows a delay of 2 ms, which nobody has to
    know to drive.
    """
    check_consistency(log, model)
    analysis, _ = search_log(log, model)
    final = final_fit(analysis)
    sure, doubtful = classify_findings(effect_findings(analysis, final), Measured.of(analysis, final))
    names = tuple(effect.name for effect in sure or doubtful)
    if analysis.body is None or not names:
        return names
    stages = stage_predictions(analysis, final)
    refitted, amended = (stages.errors(stage) for stage in ("refitted", "amended"))
    return () if worse_by(amended, refitted) <= DEFAULT_SETTINGS.prediction.worse else names


def search_log(
    log: DriveLog, model: Model, report_progress: Progress = lambda text: None, settings: GapSettings = DEFAULT_SETTINGS
) -> tuple[GapAnalysis, list[str]]:
    """Search both channels; return notes on what could not be evaluated."""
    drive = grid_drive(log, settings)
    if not (drive.has_poses or drive.has_commands):
        raise LogError(
            f"{', '.join(log.sources)}: too little to judge: it needs wheel samples with poses, or with commands, "
            "for at least some seconds of driving"
        )
    nominal_body, nominal_wheels = _vector(BODY, model), _vector(WHEEL, model)
    drive = with_known_terms(drive, model.effects, nominal_body, WHEEL.at(nominal_wheels, DELAYED_BY))
    geometry = nominal_body[:BASE_COUNT]
    body = wheels = None
    notes: list[str] = []
    if drive.has_poses:
        report_progress("wheel to body: which effects are missing")
        body = search_body(drive, nominal_body, _given(model, BODY))
        geometry = body.fit.vector[:BASE_COUNT]
    else:
        notes.append("no poses: only the way from command to wheel is judged")
    if drive.has_commands:
        report_progress("command to wheel: which effects are missing")
        wheels = search_wheels(drive, geometry, nominal_wheels, _given(model, WHEEL))
    else:
        notes.append("no commands: the way from command to wheel is not judged")
    return GapAnalysis(drive, nominal_body, nominal_wheels, body, wheels), notes


def _vector(layout: Layout, model: Model) -> Array:
    """Return a channel's parameter vector with the model's values; entries that the model lacks are neutral."""
    vector = layout.neutral.copy()
    for name, value in zip(model.parameter_names, model.point(), strict=True):
        if name in layout.place:
            vector[layout.place[name]] = value
    return vector


def _given(model: Model, layout: Layout) -> tuple[str, ...]:
    """Effects of the model that compete in a channel."""
    return tuple(setting.name for setting in model.effects if setting.name in candidates_of(layout))


WRITTEN = ("report.json", "report.html", "model.toml")


@dataclass(frozen=True)
class GapResult:
    """A report and the directory it was written to."""

    report: GapReport
    directory: Path

    def as_dict(self) -> dict[str, Any]:
        """Return the content of report.json as a JSON-serialisable dict."""
        return self.report.as_dict()

    def as_text(self) -> str:
        """Return the report as text for a terminal."""
        return f"{as_text(self.report)}\n\nwritten: {self.directory}/report.html, report.json, model.toml"


def gap(
    logs: Sequence[Path],
    robot: Path,
    out: Path,
    model: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> GapResult:
    """Find what a model misses in logs and write everything to the directory `out`.

    Without `model` it is the model that robot.toml names, else the nominal one. Raises InputError for files that cannot
    be used and for an `out` that cannot be written, or where an input would be written over; WorkError if it cannot be
    written after all.
    """
    task, loaded = _prepared(logs, robot, out, model)
    drive = loaded(list(logs))
    return _written(task.report(drive, progress), task, out)


@dataclass(frozen=True)
class _Task:
    """Inputs that the searches of all logs of one robot share."""

    model: Model
    robot: Robot
    robot_file: Path
    model_file: Path | None

    def inputs(self, logs: Sequence[Path]) -> list[Path]:
        """Return all files that are read, which no report may be written over."""
        return [*logs, self.robot_file, *([] if self.model_file is None else [self.model_file])]

    def report(self, drive: DriveLog, progress: Progress | None = None) -> GapReport:
        """Return the report on a drive, with pictures and proofs."""
        top_rad_s = self.robot.max_wheel_speed_rad_s
        return find_gap(drive, self.model, progress, pictures=True, prove=True, top_rad_s=top_rad_s)


def _searched(task: _Task, drive: DriveLog) -> GapReport | str:
    """Return the report of one log of a fleet, or the error message if the log cannot be used."""
    try:
        return task.report(drive)
    except LogError as error:
        return str(error)


def _prepared(
    logs: Sequence[Path], robot: Path, out: Path, model: Path | None, names: Sequence[str] = WRITTEN
) -> tuple[_Task, Callable[[list[Path]], DriveLog]]:
    """Return the task of searching a robot's logs, and their loader; refuse files that cannot be read or written."""
    config = load_robot_config(robot)
    model_file = model_file_of(robot, config, model)
    start = Model.nominal(config.robot) if model_file is None else load_model(model_file)
    task = _Task(start, config.robot, robot, model_file)
    refuse_directory(out, names, task.inputs(logs))

    def loaded(paths: list[Path]) -> DriveLog:
        return load_drive(paths, config.robot.ticks_per_rev, config.robot.wheel_radius_m)

    return task, loaded


def _written(report: GapReport, task: _Task, out: Path) -> GapResult:
    made = datetime.now().astimezone().isoformat(timespec="minutes")
    given = None if task.model_file is None else str(task.model_file)
    of = Provenance(task.robot.name, str(task.robot_file), given, made, version(), str(out))
    report = replace(report, provenance=of)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "report.json").write_text(as_json(report.as_dict(), indent=1), encoding="utf-8")
        (out / "report.html").write_text(page(report), encoding="utf-8")
        save_model(report.model, out / "model.toml")
        for name, picture in report.pictures.items():
            (out / f"{name}.png").write_bytes(picture)
    except OSError as error:
        raise _unwritten(out, error) from None
    return GapResult(report, out)


def _unwritten(out: Path, error: OSError) -> WorkError:
    return WorkError(f"{out}: cannot be written ({error.strerror}); give another directory")


FLEET_WRITTEN = ("fleet.json", "fleet.txt")

Spread = Callable[[Callable[[_Task, DriveLog], GapReport | str], _Task, Sequence[DriveLog]], Iterable[GapReport | str]]


def _unique_names(stems: Sequence[str]) -> list[str]:
    """Return a name for each stem: those that several logs have are numbered, past names that are taken."""
    often = Counter(stems)
    taken, names = {stem for stem in stems if often[stem] == 1}, []
    for stem in stems:
        numbered = (f"{stem}-{k}" for k in count(1))
        names.append(stem if often[stem] == 1 else next(name for name in numbered if name not in taken))
        taken.add(names[-1])
    return names


def gap_fleet(
    logs: Sequence[Path],
    robot: Path,
    out: Path,
    model: Path | None = None,
    progress: Progress | None = None,
    spread: Spread | None = None,
) -> FleetResult:
    """Search each log by itself, all of one kind of robot; a directory for each below `out`, and one table of all.

    `spread` does the searches, in the order of the logs, in this process without it. A log that holds too little to be
    judged gets a row that says so. Raises as `gap` does.
    """
    task, loaded = _prepared(logs, robot, out, model, FLEET_WRITTEN)
    drives, report_progress = [loaded([log]) for log in logs], progress or (lambda text: None)
    places = [out / name for name in _unique_names([log.stem for log in logs])]
    for place in places:
        refuse_directory(place, WRITTEN, task.inputs(logs))
    rows = []
    done = (_searched(task, drive) for drive in drives) if spread is None else spread(_searched, task, drives)
    for log, place, found in zip(logs, places, done, strict=True):
        if isinstance(found, str):
            rows.append(FleetRow(log, place, None, found))
        else:
            rows.append(FleetRow(log, place, _written(found, task, place).report))
        report_progress(f"{len(rows)} of {len(logs)}: {log}")
    result = FleetResult(tuple(rows), out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "fleet.json").write_text(as_json(result.as_dict(), indent=1), encoding="utf-8")
        (out / "fleet.txt").write_text(f"{result.table()}\n", encoding="utf-8")
    except OSError as error:
        raise _unwritten(out, error) from None
    return result
