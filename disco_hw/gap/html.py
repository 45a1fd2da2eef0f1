"""The report as one self-contained page: the answer first, then pictures, then the evidence."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

from disco_hw.gap.report import STAGES, GapReport

_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
.answer p{font-size:1.25rem;margin:.3rem 0}
table{border-collapse:collapse;margin:.6rem 0}td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #ddd}
td.n{text-align:right;font-variant-numeric:tabular-nums}img{max-width:100%}h2{margin-top:2rem}
"""


def page(report: GapReport) -> str:
    """The whole page."""
    parts = [
        f'<div class="answer">{"".join(f"<p>{escape(line)}</p>" for line in report.answer())}</div>',
        f"<p>Verdict: <b>{report.verdict}</b>. Logs: {escape(', '.join(report.sources))}.</p>",
    ]
    parts += [_picture(name, picture) for name, picture in report.pictures.items()]
    parts.append("<h2>What is missing</h2>")
    parts.append(_effects(report))
    if report.residue:
        parts.append("<h2>What is still left</h2>" + _list(report.residue))
    if report.gap:
        parts.append("<h2>The gap on data not used for fitting</h2>" + _gap(report))
    parts.append("<h2>Evidence of every candidate</h2>" + _candidates(report))
    parts.append("<h2>What this log could not have shown</h2>" + _blind(report))
    if report.notes:
        parts.append("<h2>Notes</h2>" + _list(report.notes))
    body = "\n".join(parts)
    title = "What the model misses"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>{body}</body></html>"
    )


def _picture(name: str, picture: bytes) -> str:
    data = base64.b64encode(picture).decode("ascii")
    return f'<p><img alt="{escape(name)}" src="data:image/png;base64,{data}"></p>'


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
    rows += [("unnamed", term.channel, term.form, f"{term.evidence:.0f}", "", "") for term in report.unnamed]
    if not rows:
        return "<p>Nothing that this log shows.</p>"
    head = (
        "effect",
        "channel",
        "parameters with 95 % intervals",
        "evidence",
        "not to be told from",
        "what would decide",
    )
    return _table(head, rows)


def _gap(report: GapReport) -> str:
    rows = []
    for horizon in sorted(report.gap["nominal"]):
        cells = []
        for stage in STAGES:
            e = report.gap[stage][horizon]
            low, high = e.position_ci
            cells.append(f"{1e3 * e.position_m:.1f} mm [{1e3 * low:.1f}, {1e3 * high:.1f}], {e.yaw_rad:.3f} rad")
        rows.append((f"{horizon:g} s", *cells))
    return _table(("ahead", *STAGES), rows)


def _candidates(report: GapReport) -> str:
    rows = [(c.channel, c.name, f"{c.gain:.1f}", f"{c.score:.1f}", c.verdict) for c in report.candidates]
    return _table(("channel", "effect", "gain, nats", "score (20 accepts)", "verdict"), rows)


def _blind(report: GapReport) -> str:
    rows = []
    for spot in report.blind_spots:
        size = "never" if spot.smallest_visible is None else f"{spot.smallest_visible:.3g} {spot.unit}"
        rows.append((spot.name, size, "blind to realistic sizes" if spot.blind else "", spot.experiment))
    return _table(("effect", "smallest visible", "", "the drive that shows it"), rows)
