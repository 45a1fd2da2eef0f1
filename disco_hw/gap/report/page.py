"""The report in words: for a terminal, and as one self-contained page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape

from disco_hw import reports
from disco_hw.effects import Stage
from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.report import STAGES, EffectFinding, GapReport, UnnamedFinding
from disco_hw.gap.report.events import RareEvent
from disco_hw.gap.report.judge import is_weakly_known
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.gap.settings import DEFAULT_SETTINGS, ReportSettings


def other_known_symptoms(effect: EffectFinding, settings: ReportSettings = DEFAULT_SETTINGS.report) -> tuple[str, ...]:
    """Return the parameters of a missing effect that have symptoms of their own and are known well enough."""
    described = {parameter.name: parameter for parameter in REGISTRY[effect.name].parameters}
    by_themselves = dict(REGISTRY[effect.name].other_symptoms)
    return tuple(
        name for name in by_themselves if not is_weakly_known(described[name], effect.parameters[name], settings)
    )


def sentence(effect: EffectFinding, settings: ReportSettings = DEFAULT_SETTINGS.report) -> str:
    """Describe what a missing effect does, with its values, or the nearest ones that are possible."""
    described = REGISTRY[effect.name]
    values = described.possible({name: estimate.value for name, estimate in effect.parameters.items()})
    others = dict(described.other_symptoms)
    also = (described.fill(others[name], values) for name in other_known_symptoms(effect, settings))
    return "; ".join((described.describe(values), *also))


def summary_lines(report: GapReport) -> list[str]:
    """Summarise the report in at most ten lines, for the operator of the robot.

    What is missing and how sure that is, how much it matters, what is left, which model to drive with, what to do next.
    """
    most = report.settings.report.most_listed
    effects = report.effects[:most]
    lines = _missing(report, effects)
    if effects:
        lines.append(f"How sure: with 95 % probability {'; '.join(_range(each) for each in effects)}.")
    corrections = [text for each in report.effects if (text := _pose_correction(each)) is not None]
    if corrections:
        where = "Correct the pose sensor in [pose] of robot.toml, as no model does (a missing key is 0)"
        lines.append(f"{where}: {'; '.join(corrections)}.")
    if report.events:
        told = sorted(report.events, key=lambda event: -event.share)[:most]
        text = "; ".join(event.describe() for event in sorted(told, key=report.events.index))
        more = len(report.events) - len(told)
        lines.append(f"Rare events: {text}.{f' And {more} more, listed below.' if more else ''}")
    if report.gap or report.wheels:
        lines.append(_gap_line(report))
    if report.remains is not None:
        lines.append(report.remains.describe())
    blind = [spot.name for spot in report.blind_spots if spot.blind]
    if blind:
        names = ", ".join(blind) if len(blind) <= most else f"{len(blind)} effects, listed below,"
        advice = f"Drive next: `{report.drive}`; this" if report.drive else "This"
        lines.append(f"{advice} log could not have shown {names} of realistic size.")
    if report.provenance is not None:
        lines.append(f"Go on: `{report.provenance.go_on}`.")
    return lines


def _missing(report: GapReport, effects: Sequence[EffectFinding]) -> list[str]:
    """Describe what is missing: these effects with a mark on those that the model leaves out, or else what there is."""
    written = {setting.name for setting in report.model.effects}
    lines = []
    for each in effects:
        text = sentence(each, report.settings.report)
        lines.append(f"{text[0].upper()}{text[1:]}{'' if each.name in written else ' (not in model.toml)'}.")
    more = len(report.effects) - len(effects)
    if more:
        lines[-1] += f" And {more} more, listed below."
    if not effects and report.unnamed:
        lines.append(f"Something is missing that has no name: {_describe(report.unnamed[0])}.")
    elif not effects and (report.residue or report.doubtful):
        if report.remains is None or not report.remains.is_explained:
            lines.append("Something is missing that none of the known effects explains.")
    elif not effects:
        lines.append("Nothing is missing that this log could show.")
    return lines


def _pose_correction(effect: EffectFinding) -> str | None:
    """Describe what is to be added to which key of [pose] for an effect of the pose sensor; None for any other."""
    described = REGISTRY[effect.name]
    correction = described.pose_correction({name: estimate.value for name, estimate in effect.parameters.items()})
    if correction is None:
        return None
    key, added = correction
    value = ", ".join(f"{each:+.4f}" for each in added)
    text = f"add {f'[{value}]' if len(added) > 1 else value} {described.parameters[0].unit} to {key}"
    if described.stage is Stage.POSE_TIME and added[0] < 0.0:
        text += ", and where that falls below 0 correct the stamps at their source"
    return text


def _range(effect: EffectFinding) -> str:
    """Between what ends the first parameter of an effect lies; its size, where words tell the sign."""
    described = REGISTRY[effect.name]
    parameter = described.parameters[0]
    estimate = effect.parameters[parameter.name]
    ends = estimate.low, estimate.high
    if described.sentence_below is not None and estimate.value < 0.0:
        ends = -estimate.high, -estimate.low
    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
    # As many decimals as tell the ends apart.
    width = ends[1] - ends[0]
    decimals = max(0, -math.floor(math.log10(width))) if math.isfinite(width) and width > 0.0 else 2
    return f"{effect.name} is between {ends[0]:.{decimals}f} and {ends[1]:.{decimals}f}{unit}"


def _gap_line(report: GapReport) -> str:
    """Describe the prediction errors before and after, those of the sensors' noise, and the model to drive with."""
    horizon, of = f"{report.horizon_s:g} s", report.gap or report.wheels
    if not math.isfinite(of["timed"][report.horizon_s].position_m):
        return f"No stretch of the logs is long enough to see how far {horizon} predictions are off."
    off = {
        stage: f"{1e3 * errors[report.horizon_s].position_m:.3g} mm and {errors[report.horizon_s].yaw_rad:.2g} rad"
        for stage, errors in of.items()
    }
    last = f"the sensors' noise makes {off['floor']}" if "floor" in off else f"the model as given by {off['nominal']}"
    line = (
        f"{horizon} ahead, in parts of the log that were not used, {'predictions' if report.gap else 'the wheels'} "
        f"are off by {off['timed']} with a delay and a lag alone (timed), by {off['amended']} with {_added(report)} "
        f"(amended); {last}."
    )
    if "written" in off:
        line += f" Without what no model can hold, as it is written, the amended model errs by {off['written']}."
    if report.why_not_amended is None:
        return line
    offered = report.offered if report.gap or report.offered == "timed" else "given"
    names = _names_in_model(report)
    return (
        f"{line} Drive with the {offered} model, which is in model.toml{f', with {names}' if names else ''}. "
        f"{report.why_not_amended}"
    )


def _names_in_model(report: GapReport) -> str:
    """List the effects of the model that is handed out, with those marked that are doubtful; empty without any."""
    doubtful = {one.name for one in report.doubtful}
    names = (setting.name for setting in report.model.effects)
    return ", ".join(f"{name} (doubtful)" if name in doubtful else name for name in names)


def _added(report: GapReport) -> str:
    """Describe what the amended model has, of which only the one that is handed out is known by its effects."""
    if report.why_not_amended is not None:
        return "more effects"
    names = _names_in_model(report) or "no effect"
    return f"{names} and what no model can hold" if "written" in (report.gap or report.wheels) else names


def as_text(report: GapReport) -> str:
    """Format the report as text for a terminal."""
    lines = [*(f"warning: {warning}" for warning in report.warnings), *summary_lines(report), ""]
    for effect in report.effects:
        written = _values_in_model(report, effect)
        values = ", ".join(
            f"{n} {e.value:.4g} [{e.low:.4g}, {e.high:.4g}]{f', {written[n]} in model.toml' if n in written else ''}"
            for n, e in effect.parameters.items()
        )
        out = "" if written else ", not in model.toml"
        lines.append(f"{effect.channel}: {effect.name}: {values}{out}{_confounded(effect)}")
    lines += _why_values_differ(report)
    lines += [f"{term.channel}: unnamed: {_describe(term)}{_confounded(term)}" for term in report.unnamed]
    lines += [f"doubtful: {one.name}: {one.why}" for one in report.doubtful]
    lines += [f"event: {_describe_event(event)}" for event in report.events]
    lines += [*report.residue, *_describe_logs(report), *report.notes]
    of = report.gap or report.wheels
    if of:
        title = "" if report.gap else "way and heading that the wheels make:"
        lines += [title, f"{'ahead':>6} " + " ".join(f"{stage:>20}" for stage in of)]
        for horizon in of["nominal"]:
            cells = (_in_cell(of[stage][horizon]) for stage in of)
            lines.append(f"{horizon:4g} s  " + " ".join(f"{cell:>20}" for cell in cells))
    return "\n".join(lines)


def _values_in_model(report: GapReport, effect: EffectFinding) -> dict[str, str]:
    """Return the parameters that model.toml has of an effect, formatted; empty if it lacks the effect."""
    settings = (setting for setting in report.model.effects if setting.name == effect.name)
    return {name: f"{value:.4g}" for setting in settings for name, value in setting.values.items()}


def _why_values_differ(report: GapReport) -> list[str]:
    """Return a sentence on why model.toml has other values than were found; none where it has the same.

    Without poses there are no predictions of the whole chain, and nothing is fitted to them.
    """
    pairs = (
        (f"{found.value:.4g}", _values_in_model(report, effect).get(name))
        for effect in report.effects
        for name, found in effect.parameters.items()
    )
    if not report.gap or all(written is None or written == found for found, written in pairs):
        return []
    return [
        "model.toml's values are fitted to whole predictions, from commands to poses, and may lie outside the "
        "intervals, which are of one channel at a time"
    ]


def _describe_logs(report: GapReport) -> list[str]:
    """Describe which parameters agree in several logs, and which differ from one to the next."""
    if len(report.sources) < 2:
        return []
    common = ", ".join(each.name for each in report.across if not each.differs)
    out = [f"the same in all {len(report.sources)} logs, of the robot: {common}"] if common else []
    for each in report.across:
        if each.differs:
            values = ", ".join(f"{value:.3g} [{low:.3g}, {high:.3g}]" for value, low, high in each.values)
            out.append(f"differs from log to log, of the surface, the load or the day: {each.name}: {values}")
    return out or ["no parameter is known well enough in each log to compare them"]


def _in_cell(errors: PredictionErrors) -> str:
    if not math.isfinite(errors.position_m):
        return "-"
    return f"{1e3 * errors.position_m:9.1f} mm {errors.yaw_rad:6.3f} rad"


def _describe(term: UnnamedFinding) -> str:
    """Format the equation of a term, followed by its meaning where that is known."""
    return term.form if term.meaning is None else f"{term.form} ({term.meaning})"


def _describe_event(event: RareEvent) -> str:
    """Describe an event, its channel, and how much of the channel's mismatch it is."""
    return f"{event.describe()} ({event.share:.0%} of the mismatch of {event.channel})"


def _confounded(finding: EffectFinding | UnnamedFinding) -> str:
    same = ", ".join(finding.indistinguishable_from)
    return f" (confounded with {same})" if same else ""


_CAPTIONS = {
    "gap_by_horizon": "How far predictions are off, by how far ahead they look, on data not used for fitting; the "
    "errors' axis is logarithmic; shaded: 95 % intervals.",
    "gap_by_regime": "The same as far ahead as the answer looks, by what the robot was doing.",
    "where_command_to_wheel": "Where commands and wheels disagree. Bars that end at the line hold nothing but noise.",
    "where_wheel_to_body": "Where wheels and poses disagree. Bars that end at the line hold nothing but noise.",
    "worst_stretch": "The stretch in which the wheels and the refitted model lie furthest apart.",
}
_DEFINITIONS = {
    "nominal": "the model as given",
    "refitted": "its wheel radius, axial distance and centre of turning fitted, from commands to poses",
    "timed": "a command delay and a motor lag too: what a careful engineer fits by hand",
    "amended": "with what was found, as far as predictions need it",
    "floor": "what the noise of the sensors makes of a perfect model",
    "held out": "predicted by what was fitted on other stretches of the log",
    "evidence": "twice the gain in log likelihood, less the price of the parameters",
    "95 %": "an interval that holds the value of another drive as long, under the same conditions, in 95 of 100",
}


def page(report: GapReport) -> str:
    """Return the HTML of the report: answer, definitions in the margin, pictures, findings, folded expert tables."""
    lines = "".join(f"<p>{_with_code(line)}</p>" for line in summary_lines(report))
    glossary = "".join(f"<dt>{name}</dt><dd>{escape(text)}</dd>" for name, text in _DEFINITIONS.items())
    warned = "".join(f'<p class="warn">{escape(warning)}</p>' for warning in report.warnings)
    parts = [
        warned,
        f'<div class="answer">{lines}</div>',
        _format_source(report),
        f"<aside><dl>{glossary}</dl></aside>",
    ]
    parts += [
        reports.picture(data, name, _CAPTIONS.get(name, name.replace("_", " ")))
        for name, data in report.pictures.items()
    ]
    parts.append("<h2>What is missing</h2>" + _effects(report))
    if report.doubtful:
        doubts = (f"{one.name}: {one.why}" for one in report.doubtful)
        parts.append("<h2>What fits and is not to be believed</h2>" + _list(doubts))
    if report.events:
        parts.append("<h2>Rare events</h2>" + _list(_describe_event(event) for event in report.events))
    if report.residue:
        parts.append("<h2>What is still left</h2>" + _list(report.residue))
    if len(report.sources) > 1:
        parts.append("<h2>What the logs share, and what differs</h2>" + _across(report))
    if report.notes:
        parts.append("<h2>Notes</h2>" + _list(report.notes))
    parts.append("<h2>For experts</h2>")
    if report.gap:
        parts.append(_folded("The gap on data not used for fitting", _gap(report.gap)))
        parts.append(_folded("The gap by what the robot was doing", _by_regime(report)))
    if report.wheels:
        parts.append(_folded("The wheels alone: the way and the heading that they make", _gap(report.wheels)))
    parts.append(_folded("Evidence of every candidate", _candidates(report)))
    parts.append(_folded("What this log could not have shown", _blind(report)))
    return reports.page("What the model misses", "\n".join(parts))


def _with_code(line: str) -> str:
    """Convert a line to HTML, with text between backticks as code."""
    pieces = escape(line).split("`")
    return "".join(f"<code>{piece}</code>" if k % 2 else piece for k, piece in enumerate(pieces))


def _format_source(report: GapReport) -> str:
    """Verdict, logs, and whose, when and by what."""
    line = f"Verdict: <b>{report.verdict}</b>. Logs: {escape(', '.join(report.sources))}."
    made = report.provenance
    if made is not None:
        model = "its nominal model" if made.model_file is None else made.model_file
        line += f" Robot: {escape(made.robot)} ({escape(made.robot_file)}), compared with {escape(model)}. "
        line += f"Made {escape(made.date)} by disco-hw {escape(made.version)} in {report.seconds:.0f} s."
    return f"<p>{line}</p>"


def _folded(title: str, content: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def _across(report: GapReport) -> str:
    """Every parameter that each log determines, log by log."""
    if not report.across:
        return "<p>No parameter is known well enough in each log to compare them.</p>"
    rows = [
        (
            each.name,
            "differs: of the surface, the load or the day" if each.differs else "the same: of the robot",
            *(f"{value:.4g} [{low:.4g}, {high:.4g}]" for value, low, high in each.values),
        )
        for each in report.across
    ]
    return _table(("parameter", "from log to log", *report.sources), rows)


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
        of_model = ", ".join(f"{n} = {value}" for n, value in _values_in_model(report, effect).items()) or "not in it"
        also, test = ", ".join(effect.indistinguishable_from), effect.experiment or ""
        rows.append((effect.name, effect.channel, values, of_model, f"{effect.evidence:.0f}", also, test))
    for term in report.unnamed:
        place = (
            "in the amended model" if term.in_model else "not in the model: it depends on what no model's state holds"
        )
        also, test = ", ".join(term.indistinguishable_from), f"; {term.experiment}" if term.experiment else ""
        rows.append(("unnamed", term.channel, _describe(term), "", f"{term.evidence:.0f}", also, place + test))
    if not rows:
        return "<p>Nothing that this log shows.</p>"
    head = (
        "effect", "channel", "parameters with 95 % intervals", "in model.toml", "evidence", "confounded with",
        "what would decide",
    )  # fmt: skip
    return _table(head, rows) + "".join(f"<p>{escape(line)}.</p>" for line in _why_values_differ(report))


def _gap(of: Mapping[str, Mapping[float, PredictionErrors]]) -> str:
    """Position, heading and wheel speed by horizon, with bootstrap intervals over stretches of time."""
    rows = []
    for horizon in sorted(of["nominal"]):
        errors = [of[stage][horizon] for stage in of]
        rows += [
            (f"{horizon:g} s", "position, mm", *(_with_interval(e.position_m, e.position_ci, 1e3) for e in errors)),
            ("", "heading, mrad", *(_with_interval(e.yaw_rad, e.yaw_ci, 1e3) for e in errors)),
            ("", "wheel speed, rad/s", *(_or_dash(e.wheel_rad_s) for e in errors)),
        ]
    return _table(("ahead", "error (root mean square)", *of), rows)


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
    advice = f"<p>All of it in a minute: <code>{escape(report.drive)}</code>.</p>" if report.drive else ""
    return advice + _table(("effect", "smallest visible", "proof", "", "the drive that shows it"), rows)
