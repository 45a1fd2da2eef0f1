"""The report in words: for a terminal, and as one self-contained page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report.findings import STAGES, EffectFinding, GapReport, UnnamedFinding
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.reports import style


def sentence(effect: EffectFinding) -> str:
    """What a missing effect does, with its values."""
    described = REGISTRY[effect.name]
    said: str = described.sentence.format(**{name: e.value for name, e in effect.parameters.items()})
    early = any(effect.parameters[p.name].value < p.low for p in described.parameters if p.least_fitted is not None)
    return f"{said} (before they come: a clock stamps too late)" if early else said


def answer(report: GapReport) -> list[str]:
    """The answer in at most three lines."""
    if report.effects:
        first = "; ".join(sentence(effect) for effect in report.effects) + "."
    elif report.unnamed:
        first = f"Something is missing that has no name: {report.unnamed[0].form}."
    elif report.residue or report.doubtful:
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
    off = {
        stage: f"{1e3 * report.at_horizon(stage).position_m:.3g} mm and {report.at_horizon(stage).yaw_rad:.2g} rad"
        for stage in STAGES
    }
    said = (
        f"{horizon} ahead on held-out data the amended model errs by {off['amended']}, one with geometry, delay and "
        f"lag alone (timed) by {off['timed']}; the sensors' noise makes {off['floor']}."
    )
    if report.offered == "amended":
        return said
    return f"{said} The amended model does not beat it: model.toml is the {report.offered} one; drive with that."


def as_text(report: GapReport) -> str:
    """The report for a terminal."""
    lines = [*answer(report), ""]
    for effect in report.effects:
        values = ", ".join(f"{n} {e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for n, e in effect.parameters.items())
        lines.append(f"{effect.channel}: {effect.name}: {values}{_confounded(effect)}")
    lines += [f"{term.channel}: unnamed: {term.form}{_confounded(term)}" for term in report.unnamed]
    lines += [f"doubtful: {doubt.name}: {doubt.why}" for doubt in report.doubtful]
    lines += [*report.residue, *report.notes]
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
    return f" (confounded with {same})" if same else ""


_CAPTIONS = {
    "gap_by_horizon": "How far predictions are off, by how far ahead they look, on data not used for fitting; shaded: "
    "95 % intervals. nominal: the model as given; refitted: its geometry fitted; timed: a command delay and a lag "
    "too, all a careful engineer fits by hand; amended: with what was found; floor: what the sensors' noise makes.",
    "gap_by_regime": "The same as far ahead as the answer looks, by what the robot was doing.",
    "where_command_to_wheel": "Where commands and wheels disagree. Bars that end at the line hold nothing but noise.",
    "where_wheel_to_body": "Where wheels and poses disagree. Bars that end at the line hold nothing but noise.",
    "worst_stretch": "The stretch in which the wheels and the model as it was lie furthest apart.",
}


def page(report: GapReport) -> str:
    """The whole page."""
    parts = [
        f'<div class="answer">{"".join(f"<p>{escape(line)}</p>" for line in answer(report))}</div>',
        f"<p>Verdict: <b>{report.verdict}</b>. Logs: {escape(', '.join(report.sources))}.</p>",
    ]
    parts += [
        style.picture(data, name, _CAPTIONS.get(name, name.replace("_", " "))) for name, data in report.pictures.items()
    ]
    if report.gap:
        parts.append("<h2>The gap by what the robot was doing</h2>" + _by_regime(report))
    parts.append("<h2>What is missing</h2>")
    parts.append(_effects(report))
    if report.doubtful:
        doubts = (f"{doubt.name}: {doubt.why}" for doubt in report.doubtful)
        parts.append("<h2>What fits and is not to be believed</h2>" + _list(doubts))
    if report.residue:
        parts.append("<h2>What is still left</h2>" + _list(report.residue))
    if report.gap:
        parts.append("<h2>The gap on data not used for fitting</h2>" + _gap(report))
    parts.append("<h2>Evidence of every candidate</h2>" + _candidates(report))
    parts.append("<h2>What this log could not have shown</h2>" + _blind(report))
    if report.notes:
        parts.append("<h2>Notes</h2>" + _list(report.notes))
    return style.page("What the model misses", "\n".join(parts))


def _list(items: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{cells}</tr>{lines}</table>"


def _effects(report: GapReport) -> str:
    rows = []
    for effect in report.effects:
        values = ", ".join(f"{n} = {e.value:.4g} [{e.low:.4g}, {e.high:.4g}]" for n, e in effect.parameters.items())
        also = ", ".join(effect.indistinguishable_from)
        rows.append((effect.name, effect.channel, values, f"{effect.evidence:.0f}", also, effect.experiment or ""))
    for term in report.unnamed:
        place = (
            "in the amended model" if term.in_model else "not in the model: it depends on what no model's state holds"
        )
        also, test = ", ".join(term.indistinguishable_from), f"; {term.experiment}" if term.experiment else ""
        rows.append(("unnamed", term.channel, term.form, f"{term.evidence:.0f}", also, place + test))
    if not rows:
        return "<p>Nothing that this log shows.</p>"
    head = (
        "effect",
        "channel",
        "parameters with 95 % intervals",
        "evidence",
        "confounded with",
        "what would decide",
    )
    return _table(head, rows)


def _gap(report: GapReport) -> str:
    """Position, heading and wheel speed by horizon, with bootstrap intervals over stretches of time."""
    rows = []
    for horizon in sorted(report.gap["nominal"]):
        errors = [report.gap[stage][horizon] for stage in STAGES]
        rows += [
            (f"{horizon:g} s", "position, mm", *(_with_interval(e.position_m, e.position_ci, 1e3) for e in errors)),
            ("", "heading, mrad", *(_with_interval(e.yaw_rad, e.yaw_ci, 1e3) for e in errors)),
            ("", "wheel speed, rad/s", *(_or_dash(e.wheel_rad_s) for e in errors)),
        ]
    return _table(("ahead", "error (root mean square)", *STAGES), rows)


def _with_interval(value: float, interval: tuple[float, float], factor: float) -> str:
    low, high = interval
    if not math.isfinite(value):
        return "-"
    return f"{factor * value:.1f} [{factor * low:.1f}, {factor * high:.1f}]"


def _or_dash(speed_rad_s: float) -> str:
    return f"{speed_rad_s:.3f}" if math.isfinite(speed_rad_s) else "-"


def _by_regime(report: GapReport) -> str:
    errors = [report.at_horizon(stage).by_regime_m for stage in STAGES]
    rows = [(name, *(f"{1e3 * of[name]:.1f} mm" if name in of else "" for of in errors)) for name in sorted(errors[0])]
    return _table((f"position error {report.horizon_s:g} s ahead", *STAGES), rows)


def _candidates(report: GapReport) -> str:
    rows = [(c.channel, c.name, f"{c.gain:.1f}", f"{c.score:.1f}", c.verdict) for c in report.candidates]
    selection = report.settings.selection
    most = selection.named_score * selection.heaviest
    score = f"score ({selection.named_score:g} accepts, up to {most:g} where the noise has heavy tails)"
    return _table(("channel", "effect", "gain, nats", score, "verdict"), rows)


_PROOFS = {None: "", True: "put into this log, it is found", False: "put into this log, it is not found"}


def _blind(report: GapReport) -> str:
    rows = []
    for spot in report.blind_spots:
        size = "never" if spot.smallest_visible is None else f"{spot.smallest_visible:.3g} {spot.unit}"
        rows.append(
            (spot.name, size, _PROOFS[spot.proved], "blind to realistic sizes" if spot.blind else "", spot.experiment)
        )
    ask = f"<p>All of it in a minute: <code>{escape(report.drive)}</code>.</p>" if report.drive else ""
    return ask + _table(("effect", "smallest visible", "proof", "", "the drive that shows it"), rows)
