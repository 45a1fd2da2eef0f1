"""What a study of the search for missing effects found: figures with their intervals, and who was taken for whom."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import binomtest

from tools.gap import strange_robot
from tools.gap.jobs import FORMS, KINDS, MOTORS, NAMED, OUTSIDE, Result


def wilson(right: int, count: int) -> tuple[float, float]:
    """95 % interval of a share."""
    if not count:
        return 0.0, 1.0
    interval = binomtest(right, count).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def summary(results: Sequence[Result]) -> dict[str, float]:
    """Figures by kind, under stable keys."""
    figures: dict[str, float] = {}
    for kind in KINDS:
        of = [result for result in results if result.kind == kind]
        if not of:
            continue
        right = sum(result.right for result in of)
        low, high = wilson(right, len(of))
        figures |= {
            f"gap.{kind}.logs": len(of),
            f"gap.{kind}.right": right / len(of),
            f"gap.{kind}.right_low": low,
            f"gap.{kind}.right_high": high,
            f"gap.{kind}.told": sum(result.told for result in of) / len(of),
            f"gap.{kind}.cpu_s": float(np.median([result.cpu_s for result in of])),
        }
        closed = [result.closed for result in of if result.closed is not None]
        if closed and kind not in ("none", "dirty"):
            figures[f"gap.{kind}.closed_median"] = float(np.median(closed))
            figures[f"gap.{kind}.closed_by_half"] = float(np.mean(np.array(closed) >= 0.5))
            written = [result.closed_as_written or 0.0 for result in of if result.closed is not None]
            figures[f"gap.{kind}.written_by_half"] = float(np.mean(np.array(written) >= 0.5))
            figures[f"gap.{kind}.closed_of"] = len(closed)
        errors = [error for result in of for error in result.errors]
        covered = [inside for result in of for inside in result.covered]
        if errors and kind in ("single", "pairs", "weak"):
            figures[f"gap.{kind}.parameter_error_median"] = float(np.median(errors))
            figures[f"gap.{kind}.covered"] = float(np.mean(covered))
            figures[f"gap.{kind}.covered_of"] = len(covered)
    return figures


def table(results: Sequence[Result]) -> list[str]:
    """The figures by kind, as Markdown."""
    figures = summary(results)
    lines = [
        "| hidden | right | 95 % interval | or said to be too small | gap closed, median | parameter error, median "
        "| intervals hold | CPU |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind, words in KINDS.items():
        count = int(figures.get(f"gap.{kind}.logs", 0))
        if not count:
            continue

        def cell(key: str, form: str, kind: str = kind) -> str:
            value = figures.get(f"gap.{kind}.{key}")
            return "" if value is None else form.format(value)

        holds = f" of {int(figures[f'gap.{kind}.covered_of'])}" if f"gap.{kind}.covered_of" in figures else ""
        lines.append(
            f"| {words} | {round(figures[f'gap.{kind}.right'] * count)} of {count} | "
            f"{figures[f'gap.{kind}.right_low']:.0%} to {figures[f'gap.{kind}.right_high']:.0%} | "
            f"{round(figures[f'gap.{kind}.told'] * count)} of {count} | "
            f"{cell('closed_median', '{:.0%}')} | {cell('parameter_error_median', '{:.1%}')} | "
            f"{cell('covered', '{:.0%}')}{holds} | {cell('cpu_s', '{:.1f} s')} |"
        )
    return lines


def per_effect(results: Sequence[Result]) -> list[str]:
    """Shares by what was hidden, over all kinds with one thing hidden, as Markdown."""
    kinds = [kind for kind in KINDS if kind not in ("none", "dirty", "pairs")]
    kinds = [kind for kind in kinds if any(result.kind == kind for result in results)]
    lines = ["| hidden | " + " | ".join(kinds) + " |", "|---" * (len(kinds) + 1) + "|"]
    for name in (*NAMED, *OUTSIDE, *FORMS, *strange_robot.FORMS):
        cells = []
        for kind in kinds:
            of = [result.right for result in results if result.kind == kind and result.hidden == [name]]
            cells.append(f"{sum(of)} of {len(of)}" if of else "")
        if any(cells):
            lines.append(f"| `{name}` | " + " | ".join(cells) + " |")
    return lines


def confusion(results: Sequence[Result]) -> tuple[list[str], list[str], np.ndarray]:
    """Rows: hidden, columns: named (and unnamed, nothing), counts over the logs with one thing or nothing hidden."""
    of = [result for result in results if result.kind in ("single", "outside", "forms", "none")]
    rows = [*[name for name in (*NAMED, *FORMS, *OUTSIDE) if any(r.hidden == [name] for r in of)], "nothing"]
    columns = [*NAMED, "unnamed", "nothing"]
    counts = np.zeros((len(rows), len(columns)), dtype=int)
    for result in of:
        row = rows.index(result.hidden[0] if result.hidden else "nothing")
        named = [name for name in result.named if name in result.hidden or name not in MOTORS]
        found = [*named, *(["unnamed"] if result.unnamed else [])] or ["nothing"]
        for name in found:
            counts[row, columns.index(name)] += 1
    return rows, columns, counts


def write(results: Sequence[Result], out: Path, revision: str) -> None:
    """Figures, tables and picture."""
    content = {
        "revision": revision, "figures": summary(results), "results": [asdict(result) for result in results],
    }  # fmt: skip
    (out / "gap_study.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    rows, columns, counts = confusion(results)
    lines = [*table(results), "", *per_effect(results), "", "| hidden | " + " | ".join(columns) + " |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    for name, row in zip(rows, counts, strict=True):
        lines.append(f"| {name} | " + " | ".join(str(count) if count else "" for count in row) + " |")
    (out / "gap_confusion.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    draw(rows, columns, counts, out / "gap_confusion.png")


def draw(rows: list[str], columns: list[str], counts: np.ndarray, path: Path) -> None:
    """The confusion matrix as a picture; a row's shade is its share."""
    figure = Figure(figsize=(9, 0.3 * len(rows) + 2.6))
    axes = figure.add_subplot()
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(np.arange(len(columns) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(rows) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="#e4e4e4", linewidth=0.6)
    axes.tick_params(which="both", length=0)
    axes.set_xlabel("named")
    axes.set_ylabel("hidden")
    for y, x in np.argwhere(counts > 0):
        colour = "white" if share[y, x] > 0.5 else "black"
        axes.text(x, y, str(counts[y, x]), ha="center", va="center", color=colour, fontsize=9)
    figure.savefig(path, dpi=110, bbox_inches="tight")
