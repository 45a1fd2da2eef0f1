"""The answer: verdict, effects with intervals, what is unnamed, what could not be seen, and the held-out gap."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.search.cross_validation import WORSE, PredictionErrors, worse_by
from disco_hw.gap.search.intervals import ParameterEstimate
from disco_hw.model import Model

REPORTED_HORIZON_S = 2.0
STAGES = ("nominal", "refitted", "amended", "floor")
ALL_IN_ONE = "separate"


@dataclass(frozen=True, slots=True)
class ChannelFinding:
    """Whether simulation and data disagree in a channel, and in which regimes most."""

    name: str
    significant: bool
    where: str


@dataclass(frozen=True)
class EffectFinding:
    """An effect that is missing: its parameters, evidence (score), and what cannot be told from it."""

    name: str
    channel: str
    parameters: dict[str, ParameterEstimate]
    evidence: float
    indistinguishable_from: tuple[str, ...] = ()
    experiment: str | None = None

    def sentence(self) -> str:
        """What it does, in words."""
        return REGISTRY[self.name].sentence.format(**{name: e.value for name, e in self.parameters.items()})


@dataclass(frozen=True)
class UnnamedFinding:
    """Something missing that is none of the named effects, as a term of the model, and what cannot be told from it."""

    channel: str
    form: str
    evidence: float
    in_model: bool = True
    indistinguishable_from: tuple[str, ...] = ()
    experiment: str | None = None


@dataclass(frozen=True, slots=True)
class CandidateEvidence:
    """What a candidate's fit promised on top of what was accepted, or, if accepted, is worth."""

    channel: str
    name: str
    gain: float
    score: float
    verdict: str


@dataclass(frozen=True)
class GapReport:
    """What `find_gap` returns; `model` is the amended one."""

    sources: tuple[str, ...]
    channels: tuple[ChannelFinding, ...]
    effects: tuple[EffectFinding, ...]
    unnamed: tuple[UnnamedFinding, ...]
    blind_spots: tuple[BlindSpot, ...]
    gap: dict[str, dict[float, PredictionErrors]]
    model: Model
    seconds: float
    residue: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    candidates: tuple[CandidateEvidence, ...] = ()
    pictures: dict[str, bytes] = field(default_factory=dict, repr=False)

    @property
    def verdict(self) -> str:
        """`effects_found`, `nothing_missing` or `unexplained`."""
        if self.effects:
            return "effects_found"
        return "unexplained" if self.unnamed or self.residue else "nothing_missing"

    def as_dict(self) -> dict[str, Any]:
        """The content of report.json."""
        return {
            "verdict": self.verdict,
            "channels": [
                {"name": channel.name, "significant": channel.significant, "where": channel.where}
                for channel in self.channels
            ],
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
                {
                    "channel": term.channel,
                    "form": term.form,
                    "evidence": term.evidence,
                    "in_model": term.in_model,
                    "indistinguishable_from": list(term.indistinguishable_from),
                    "experiment": term.experiment,
                }
                for term in self.unnamed
            ],
            "residue": list(self.residue),
            "blind_spots": [
                {
                    "name": spot.name,
                    "parameter": spot.parameter,
                    "unit": spot.unit,
                    "smallest_visible": spot.smallest_visible,
                    "blind": spot.blind,
                    "experiment": spot.experiment,
                }
                for spot in self.blind_spots
            ],
            "drive": self.drive,
            "gap": self._gap_dict(),
            "notes": list(self.notes),
            "seconds": self.seconds,
        }

    def _gap_dict(self) -> dict[str, Any]:
        if not self.gap:
            return {"horizon_s": REPORTED_HORIZON_S, "held_out": True}
        stages = {stage: _errors_dict(self.gap[stage][REPORTED_HORIZON_S]) for stage in STAGES}
        horizons = [
            {"horizon_s": horizon, **{stage: _errors_dict(self.gap[stage][horizon]) for stage in STAGES}}
            for horizon in self.gap["nominal"]
        ]
        return {
            "horizon_s": REPORTED_HORIZON_S, "held_out": True, **stages, "amended_is_worse": self.amended_is_worse,
            "horizons": horizons,
        }  # fmt: skip

    def answer(self) -> list[str]:
        """The answer in at most three lines."""
        if self.effects:
            first = "; ".join(effect.sentence() for effect in self.effects) + "."
        elif self.unnamed:
            first = f"Something is missing that has no name: {self.unnamed[0].form}."
        elif self.residue:
            first = "Something is missing that none of the known effects explains."
        else:
            first = "Nothing is missing that this log could show."
        lines = [first[0].upper() + first[1:]]
        if self.gap and not self._told:
            lines.append(
                f"No stretch of the logs is long enough to see how far {REPORTED_HORIZON_S:g} s predictions are off."
            )
        elif self.gap:
            mm = {stage: 1e3 * self.gap[stage][REPORTED_HORIZON_S].position_m for stage in STAGES}
            added = "adding it takes" if len(self.effects) + len(self.unnamed) == 1 else "the amended model takes"
            worse = " Do not drive with it: it predicts worse than without." if self.amended_is_worse else ""
            lines.append(
                f"{added[0].upper()}{added[1:]} the {REPORTED_HORIZON_S:g} s position error from "
                f"{mm['refitted']:.0f} mm (nominal {mm['nominal']:.0f} mm) to {mm['amended']:.0f} mm; "
                f"noise alone gives {mm['floor']:.0f} mm.{worse}"
            )
        blind = [spot.name for spot in self.blind_spots if spot.blind]
        if blind:
            drive = f": `{self.drive}` would" if self.drive else ""
            lines.append(f"This log could not have shown {', '.join(blind)} of realistic size{drive}.")
        return lines

    @property
    def _told(self) -> bool:
        """Whether the log has stretches as long as the horizon that is told."""
        return math.isfinite(self.gap["refitted"][REPORTED_HORIZON_S].position_m)

    @property
    def amended_is_worse(self) -> bool:
        """Whether the amended model predicts held-out data worse than the refitted one, position or heading."""
        if not self.gap:
            return False
        before, after = (self.gap[stage][REPORTED_HORIZON_S] for stage in ("refitted", "amended"))
        return worse_by(before, after) > WORSE

    @property
    def drive(self) -> str | None:
        """The drive of at most a minute that shows what this log could not; None if there is nothing of that kind."""
        scripts = {REGISTRY[spot.name].script for spot in self.blind_spots if spot.blind}
        if not scripts:
            return None
        return f"disco-hw drive ROBOT.toml --script {scripts.pop() if len(scripts) == 1 else ALL_IN_ONE}"

    def as_text(self) -> str:
        """For a terminal."""
        lines = [*self.answer(), ""]
        for effect in self.effects:
            values = ", ".join(f"{n} {e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for n, e in effect.parameters.items())
            lines.append(f"{effect.channel}: {effect.name}: {values}{_confounded(effect)}")
        lines += [f"{term.channel}: unnamed: {term.form}{_confounded(term)}" for term in self.unnamed]
        lines += list(self.residue)
        if self.gap:
            lines += ["", f"{'ahead':>6} " + " ".join(f"{stage:>20}" for stage in STAGES)]
            for horizon in self.gap["nominal"]:
                cells = (_in_cell(self.gap[stage][horizon]) for stage in STAGES)
                lines.append(f"{horizon:4g} s  " + " ".join(f"{cell:>20}" for cell in cells))
        return "\n".join(lines)


def _in_cell(errors: PredictionErrors) -> str:
    if not math.isfinite(errors.position_m):
        return "-"
    return f"{1e3 * errors.position_m:9.1f} mm {errors.yaw_rad:6.3f} rad"


def _confounded(finding: EffectFinding | UnnamedFinding) -> str:
    same = ", ".join(finding.indistinguishable_from)
    return f" (not to be told from {same})" if same else ""


def _errors_dict(errors: PredictionErrors) -> dict[str, Any]:
    return {
        "position_rmse_m": errors.position_m,
        "position_ci95_m": list(errors.position_ci),
        "yaw_rmse_rad": errors.yaw_rad,
        "yaw_ci95_rad": list(errors.yaw_ci),
        "wheel_rmse_rad_s": errors.wheel_rad_s,
        "by_regime_m": errors.by_regime_m,
    }
