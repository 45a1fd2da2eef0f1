"""One call: logs and a model in, the report out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.data.layout import BASE_COUNT, BODY, DELAYED_BY, WHEEL, Layout
from disco_hw.gap.report.amend import amended_model
from disco_hw.gap.report.findings import GapReport
from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.candidates import candidates_of
from disco_hw.gap.search.channel_search import search_body, search_wheels
from disco_hw.gap.search.predictive_pruning import prune, pruning_sentences
from disco_hw.gap.search.unnamed_terms import with_known_terms
from disco_hw.log.drive import DriveLog, concatenate
from disco_hw.log.errors import LogError
from disco_hw.model import Model

Array = NDArray[np.float64]
Progress = Callable[[str], None]


def find_gap(
    logs: DriveLog | Sequence[DriveLog],
    model: Model,
    progress: Progress | None = None,
    pictures: bool = False,
    top_rad_s: float | None = None,
) -> GapReport:
    """Find where logs and model disagree, name what is missing, amend the model and show the gap shrink.

    `logs`: one drive or several of one robot. `model`: nominal geometry, with the effects that are known already;
    those are refitted, not reported. `progress` is told what is being done; `pictures` draws them too. `top_rad_s`: the
    robot's largest wheel speed, without which it is not known to which speed limits the logs are blind. Raises LogError
    if the logs hold too little to judge either channel.
    """
    began = time.perf_counter()
    say = progress or (lambda text: None)
    log = logs if isinstance(logs, DriveLog) else concatenate(logs)
    analysis, notes = _searched(log, model, say)
    analysis = replace(analysis, top_rad_s=top_rad_s)
    say("intervals, blind spots and the gap on held-out data")
    effects, unnamed = analysis.effects(), analysis.unnamed()
    named = {effect.name: effect.parameters for effect in analysis.effects(given=True)}
    amended, remarks = amended_model(model, named, analysis.terms(), analysis.parts())
    gap = analysis.gap() if analysis.body is not None else {}
    return GapReport(
        sources=log.sources,
        channels=analysis.channels(effects, (term.channel for term in unnamed)),
        effects=effects,
        unnamed=unnamed,
        blind_spots=analysis.blind_spots(effects),
        gap=gap,
        model=amended,
        residue=(*pruning_sentences(analysis), *analysis.residue()),
        notes=(*log.notes, *notes, *remarks),
        candidates=analysis.candidates(),
        pictures=analysis.pictures(gap) if pictures else {},
        seconds=time.perf_counter() - began,
    )


def missing_effects(log: DriveLog, model: Model) -> tuple[str, ...]:
    """Only the names of what a log shows and a model lacks, the surest first; raises LogError as `find_gap`."""
    analysis, _ = _searched(log, model, lambda text: None)
    return tuple(effect.name for effect in analysis.effects())


def _searched(log: DriveLog, model: Model, say: Progress) -> tuple[GapAnalysis, list[str]]:
    """Both channels searched, without what makes predictions worse; and notes on what could not be judged."""
    drive = grid_drive(log)
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
        say("wheel to body: which effects are missing")
        body = search_body(drive, nominal_body, _given(model, BODY))
        geometry = body.fit.vector[:BASE_COUNT]
    else:
        notes.append("no poses: only the way from command to wheel is judged")
    if drive.has_commands:
        say("command to wheel: which effects are missing")
        wheels = search_wheels(drive, geometry, nominal_wheels, _given(model, WHEEL))
    else:
        notes.append("no commands: the way from command to wheel is not judged")
    return prune(GapAnalysis(drive, nominal_body, nominal_wheels, body, wheels)), notes


def _vector(layout: Layout, model: Model) -> Array:
    """The model's parameters as a channel's vector."""
    vector = layout.neutral.copy()
    for name, value in zip(model.parameter_names, model.point(), strict=True):
        if name in layout.place:
            vector[layout.place[name]] = value
    return vector


def _given(model: Model, layout: Layout) -> tuple[str, ...]:
    """Effects of the model that compete in a channel."""
    return tuple(setting.name for setting in model.effects if setting.name in candidates_of(layout))
