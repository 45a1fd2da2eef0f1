"""Report of a search: findings, effects that a log could not show, the amended model, page and figures.

This module has the report as data: verdict, effects with intervals, unnamed terms, blind spots, the held-out gap.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.report.events import RareEvent
from disco_hw.gap.report.remains import Remains
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings, PredictionSettings
from disco_hw.model import Model

STAGES = ("nominal", "refitted", "timed", "amended", "floor")
ALL_IN_ONE = "separate"


def reached_horizon_s(gap: Mapping[str, Mapping[float, PredictionErrors]], settings: PredictionSettings) -> float:
    """Return the horizon of the report (s): that of the settings, or the longest below it that the runs reach."""
    errors = gap.get("timed", {})
    reached = [s for s, e in errors.items() if s <= settings.reported_horizon_s and math.isfinite(e.position_m)]
    return max(reached, default=settings.reported_horizon_s)


def handed_out(offered: str, errors: Mapping[str, object]) -> str:
    """Return the stage whose errors are those of model.toml: the amended model counts as it is written."""
    return "written" if offered == "amended" and "written" in errors else offered


@dataclass(frozen=True, slots=True)
class ChannelFinding:
    """Whether simulation and data disagree in a channel, and in which regimes most."""

    name: str
    significant: bool
    where: str


@dataclass(frozen=True)
class EffectFinding:
    """An effect that is missing: its parameters, evidence (score), and what is confounded with it."""

    name: str
    channel: str
    parameters: dict[str, ParameterEstimate]
    evidence: float
    indistinguishable_from: tuple[str, ...] = ()
    experiment: str | None = None


@dataclass(frozen=True)
class UnnamedFinding:
    """Something missing that is none of the named effects, as a term of the model, and what is confounded with it.

    `meaning`: what a robot does of which such a term is found; None where the equation is all that is known.
    """

    channel: str
    form: str
    evidence: float
    in_model: bool = True
    indistinguishable_from: tuple[str, ...] = ()
    experiment: str | None = None
    meaning: str | None = None


@dataclass(frozen=True, slots=True)
class LowConfidence:
    """An effect that fits and is not reported as found, and why."""

    name: str
    why: str


@dataclass(frozen=True, slots=True)
class AcrossLogs:
    """A parameter in each of several logs of one robot, as (value, low, high), and whether they differ."""

    name: str
    values: tuple[tuple[float, float, float], ...]
    differs: bool


@dataclass(frozen=True, slots=True)
class Provenance:
    """Whose logs were searched, with which files, when (ISO 8601) and by which version; where the answer lies."""

    robot: str
    robot_file: str
    model_file: str | None
    date: str
    version: str
    directory: str

    @property
    def go_on(self) -> str:
        """The command that drives with the model that is handed out."""
        return shlex.join(("disco-hw", "run", self.robot_file, "--model", f"{self.directory}/model.toml"))


@dataclass(frozen=True, slots=True)
class CandidateEvidence:
    """Evidence of a candidate: the gain that its fit promised beside the accepted ones, or its own if accepted."""

    channel: str
    name: str
    gain: float
    score: float
    verdict: str


@dataclass(frozen=True)
class GapReport:
    """Result of `find_gap`; `model` is the one of the stage `offered`: the amended one, if it predicts best.

    `gap` holds errors of poses by stage and horizon, `wheels` those of the wheels alone; either is empty where it could
    not be judged. `written` in them: the amended model as it is written, where that lacks a term which no model can
    carry. `across`: what several logs say of each parameter. `warnings`: what contradicts itself in logs that are
    still of use.
    """

    sources: tuple[str, ...]
    channels: tuple[ChannelFinding, ...]
    effects: tuple[EffectFinding, ...]
    unnamed: tuple[UnnamedFinding, ...]
    blind_spots: tuple[BlindSpot, ...]
    gap: dict[str, dict[float, PredictionErrors]]
    model: Model
    seconds: float
    offered: str = "amended"
    residue: tuple[str, ...] = ()
    doubtful: tuple[LowConfidence, ...] = ()
    notes: tuple[str, ...] = ()
    candidates: tuple[CandidateEvidence, ...] = ()
    pictures: dict[str, bytes] = field(default_factory=dict, repr=False)
    settings: GapSettings = DEFAULT_SETTINGS
    wheels: dict[str, dict[float, PredictionErrors]] = field(default_factory=dict)
    across: tuple[AcrossLogs, ...] = ()
    provenance: Provenance | None = None
    warnings: tuple[str, ...] = ()
    remains: Remains | None = None
    events: tuple[RareEvent, ...] = ()

    @property
    def horizon_s(self) -> float:
        """Horizon of the report's errors (s)."""
        return reached_horizon_s(self.gap or self.wheels, self.settings.prediction)

    def at_horizon(self, stage: str) -> PredictionErrors:
        """Errors of a stage as far ahead as the answer looks."""
        return self.gap[stage][self.horizon_s]

    @property
    def verdict(self) -> str:
        """`effects_found`, `partly_explained`, `nothing_missing` or `unexplained`.

        Partly where the model that is handed out errs by more than twice the sensors' noise.
        """
        if self.effects:
            return "effects_found" if self.remains is None or self.remains.is_explained else "partly_explained"
        return "unexplained" if self.unnamed or self.residue or self.doubtful else "nothing_missing"

    def as_dict(self) -> dict[str, Any]:
        """Return the content of report.json as a JSON-serialisable dict."""
        return {
            "verdict": self.verdict,
            "warnings": list(self.warnings),
            "channels": [asdict(channel) for channel in self.channels],
            "effects": [
                {
                    "name": effect.name,
                    "channel": effect.channel,
                    "parameters": {
                        name: {"value": e.value, "ci95": [e.low, e.high]} for name, e in effect.parameters.items()
                    },
                    "evidence": effect.evidence,
                    "indistinguishable_from": list(effect.indistinguishable_from),
                    "experiment": effect.experiment,
                }
                for effect in self.effects
            ],
            "unnamed": [
                asdict(term) | {"indistinguishable_from": list(term.indistinguishable_from)} for term in self.unnamed
            ],
            "doubtful": [asdict(one) for one in self.doubtful],
            "residue": list(self.residue),
            "events": [asdict(event) for event in self.events],
            "blind_spots": [asdict(spot) for spot in self.blind_spots],
            "drive": self.drive,
            "gap": self._gap_dict(),
            "wheels": [
                {"horizon_s": horizon, **{stage: _errors_dict(of[horizon]) for stage, of in self.wheels.items()}}
                for horizon in self.wheels.get("nominal", ())
            ],
            "offered": self.offered,
            "remains": None if self.remains is None else self.remains.as_dict(),
            "across_logs": [
                {"name": each.name, "values_ci95": [list(value) for value in each.values], "differs": each.differs}
                for each in self.across
            ],
            "provenance": None if self.provenance is None else asdict(self.provenance),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def _gap_dict(self) -> dict[str, Any]:
        if not self.gap:
            return {"horizon_s": self.horizon_s, "held_out": True}
        known = [stage for stage in (*STAGES, "written") if stage in self.gap]
        stages = {stage: _errors_dict(self.at_horizon(stage)) for stage in known}
        horizons = [
            {"horizon_s": horizon, **{stage: _errors_dict(self.gap[stage][horizon]) for stage in known}}
            for horizon in self.gap["nominal"]
        ]
        return {
            "horizon_s": self.horizon_s, "held_out": True, **stages, "offered": self.offered,
            "why_not_amended": self.why_not_amended, "horizons": horizons,
        }  # fmt: skip

    @property
    def why_not_amended(self) -> str | None:
        """Why a plainer model is offered than the amended one, in a sentence; None if the amended one is."""
        if self.offered == "amended":
            return None
        return "The amended model has more effects and does not clearly predict better."

    @property
    def drive(self) -> str | None:
        """The drive of at most a minute that shows what this log could not; None if there is nothing of that kind."""
        scripts = {REGISTRY[spot.name].script for spot in self.blind_spots if spot.blind}
        if not scripts:
            return None
        return f"disco-hw drive ROBOT.toml --script {scripts.pop() if len(scripts) == 1 else ALL_IN_ONE}"


def _errors_dict(errors: PredictionErrors) -> dict[str, Any]:
    return {
        "position_rmse_m": errors.position_m,
        "position_ci95_m": list(errors.position_ci),
        "yaw_rmse_rad": errors.yaw_rad,
        "yaw_ci95_rad": list(errors.yaw_ci),
        "wheel_rmse_rad_s": errors.wheel_rad_s,
        "by_regime_m": errors.by_regime_m,
    }


_COLUMNS = ("log", "found", "doubtful", "ahead", "timed", "offered", "floor", "model")


@dataclass(frozen=True)
class FleetRow:
    """Result for one log of a fleet: `directory` has its report; `why_not` says why there is none."""

    log: Path
    directory: Path
    report: GapReport | None
    why_not: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the log's row of fleet.json as a JSON-serialisable dict."""
        report = self.report
        if report is None:
            return {"log": str(self.log), "verdict": "not_judged", "why_not": self.why_not}
        errors = report.gap or report.wheels
        return {
            "log": str(self.log),
            "verdict": report.verdict,
            "effects": {
                effect.name: {name: [e.value, e.low, e.high] for name, e in effect.parameters.items()}
                for effect in report.effects
            },
            "unnamed": [term.form for term in report.unnamed],
            "doubtful": [one.name for one in report.doubtful],
            "offered": report.offered,
            "horizon_s": report.horizon_s,
            "held_out": {stage: _errors_dict(of[report.horizon_s]) for stage, of in errors.items()},
            "judged_by": "poses" if report.gap else "wheels",
            "directory": str(self.directory),
        }  # fmt: skip

    def cells(self) -> tuple[str, ...]:
        """Return the row as text, one cell per column of the table."""
        report = self.report
        if report is None:
            return (str(self.log), f"not judged: {self.why_not}", *[""] * (len(_COLUMNS) - 2))
        values = [
            f"{effect.name} {', '.join(f'{e.value:.3g}' for e in effect.parameters.values())}"
            for effect in report.effects
        ]
        errors, horizon_s = report.gap or report.wheels, report.horizon_s

        def cell(stage: str) -> str:
            if stage not in errors or not math.isfinite(errors[stage][horizon_s].position_m):
                return "-"
            error = errors[stage][horizon_s]
            return f"{1e3 * error.position_m:.1f} mm {1e3 * error.yaw_rad:.0f} mrad"

        # Wheels without poses have no geometry to refit: as given is what they have in its place.
        offered = report.offered if report.offered in errors else "nominal"
        return (
            str(self.log),
            "; ".join([*values, *(term.form for term in report.unnamed)]) or "nothing",
            ", ".join(one.name for one in report.doubtful) or "-",
            f"{horizon_s:g} s",
            cell("timed"),
            cell(handed_out(offered, errors)),
            cell("floor"),
            report.offered,
        )


@dataclass(frozen=True)
class FleetResult:
    """One row a log, and the directory that they were written to."""

    rows: tuple[FleetRow, ...]
    directory: Path

    def as_dict(self) -> dict[str, Any]:
        """Return the content of fleet.json as a JSON-serialisable dict."""
        return {"logs": [row.as_dict() for row in self.rows]}

    def table(self) -> str:
        """One line a log under a line of headings; errors are held out, as far ahead as the row says."""
        lines = [_COLUMNS, *(row.cells() for row in self.rows)]
        lines_with_report = [
            line for row, line in zip((None, *self.rows), lines, strict=True) if row is None or row.report
        ]
        widths = [max(len(line[k]) for line in (lines if k == 0 else lines_with_report)) for k in range(len(_COLUMNS))]
        padded = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
        return "\n".join(line.rstrip() for line in padded)

    def as_text(self) -> str:
        """Return the table and the paths of its files as text for a terminal."""
        return f"{self.table()}\n\nwritten: {self.directory}/fleet.txt, fleet.json, and a directory for each log"
