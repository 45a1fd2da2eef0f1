"""The report in words: the answer in three lines, and the rest for a terminal."""

from __future__ import annotations

import math

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report.findings import STAGES, EffectFinding, GapReport, UnnamedFinding
from disco_hw.gap.search.cross_validation import PredictionErrors


def sentence(effect: EffectFinding) -> str:
    """What a missing effect does, with its values."""
    words: str = REGISTRY[effect.name].sentence
    return words.format(**{name: e.value for name, e in effect.parameters.items()})


def answer(report: GapReport) -> list[str]:
    """The answer in at most three lines."""
    if report.effects:
        first = "; ".join(sentence(effect) for effect in report.effects) + "."
    elif report.unnamed:
        first = f"Something is missing that has no name: {report.unnamed[0].form}."
    elif report.residue:
        first = "Something is missing that none of the known effects explains."
    else:
        first = "Nothing is missing that this log could show."
    lines = [first[0].upper() + first[1:]]
    if report.gap:
        lines.append(_gap_line(report))
    blind = [spot.name for spot in report.blind_spots if spot.blind]
    if blind:
        drive = f": `{report.drive}` would" if report.drive else ""
        lines.append(f"This log could not have shown {', '.join(blind)} of realistic size{drive}.")
    return lines


def _gap_line(report: GapReport) -> str:
    horizon = f"{report.horizon_s:g} s"
    if not math.isfinite(report.at_horizon("refitted").position_m):
        return f"No stretch of the logs is long enough to see how far {horizon} predictions are off."
    mm = {stage: 1e3 * report.at_horizon(stage).position_m for stage in STAGES}
    added = "Adding it takes" if len(report.effects) + len(report.unnamed) == 1 else "The amended model takes"
    worse = " Do not drive with it: it predicts worse than without." if report.amended_is_worse else ""
    return (
        f"{added} the {horizon} position error from {mm['refitted']:.0f} mm (nominal {mm['nominal']:.0f} mm) to "
        f"{mm['amended']:.0f} mm; noise alone gives {mm['floor']:.0f} mm.{worse}"
    )


def as_text(report: GapReport) -> str:
    """The report for a terminal."""
    lines = [*answer(report), ""]
    for effect in report.effects:
        values = ", ".join(f"{n} {e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for n, e in effect.parameters.items())
        lines.append(f"{effect.channel}: {effect.name}: {values}{_confounded(effect)}")
    lines += [f"{term.channel}: unnamed: {term.form}{_confounded(term)}" for term in report.unnamed]
    lines += list(report.residue)
    if report.gap:
        lines += ["", f"{'ahead':>6} " + " ".join(f"{stage:>20}" for stage in STAGES)]
        for horizon in report.gap["nominal"]:
            cells = (_in_cell(report.gap[stage][horizon]) for stage in STAGES)
            lines.append(f"{horizon:4g} s  " + " ".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def _in_cell(errors: PredictionErrors) -> str:
    if not math.isfinite(errors.position_m):
        return "-"
    return f"{1e3 * errors.position_m:9.1f} mm {errors.yaw_rad:6.3f} rad"


def _confounded(finding: EffectFinding | UnnamedFinding) -> str:
    same = ", ".join(finding.indistinguishable_from)
    return f" (not to be told from {same})" if same else ""
