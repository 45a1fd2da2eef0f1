"""`make gap-study`: how often the search for missing effects is right, on simulated robots with something hidden.

Writes `gap_study.json`, the confusion matrix as a table (`gap_confusion.md`) and as a picture (`gap_confusion.png`).
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path

# Each process works alone on one log: a second thread for its small matrices would only be in another one's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from disco_hw.gap import find_gap
from disco_hw.model import Model
from tools.gap_logs import NAMED, realistic, simulated_drive

MODEL = Model(0.061, 0.415, 0.238)
OUTSIDE = ("x_wheel_ripple", "x_motor_droop", "x_shared_supply", "x_speed_squared_drag", "x_carpet_patch")
# Another form of a named family, and the names that count as the family's.
FORMS = {
    "x_second_order_motor": {"motor_lag", "command_delay"},
    "x_slew_limited_motor": {"motor_lag", "command_delay"},
    "x_saturating_turn_slip": {"turn_slip"},
    "x_smooth_deadband": {"deadband"},
}
# Exactly the same equations: naming either is right.
ALIKE = {"pose_offset": "lateral_icr"}
KINDS = ("single", "weak", "none", "dirty", "pairs", "outside", "forms", "circle")


@dataclass(frozen=True)
class Job:
    """One log to make and search."""

    kind: str
    hidden: dict[str, float | tuple[float, ...]]
    seed: int
    drive: str = "rich"
    dirty: bool = False


@dataclass(frozen=True)
class Result:
    """What was found in one log; errors at 2 s in mm, the share of the removable gap closed, parameter errors."""

    kind: str
    hidden: list[str]
    seed: int
    named: list[str]
    unnamed: list[str]
    residue: int
    blind: list[str]
    refitted_mm: float
    amended_mm: float
    floor_mm: float
    errors: list[float]
    covered: list[bool]
    cpu_s: float

    @property
    def right(self) -> bool:
        """Whether exactly what was hidden was named; the rule depends on the kind."""
        named, hidden = set(self.named), {ALIKE.get(name, name) for name in self.hidden}
        if self.kind == "outside":
            return not named and bool(self.unnamed)
        if self.kind == "forms":
            return bool(named & FORMS[self.hidden[0]]) and (bool(self.residue or self.unnamed))
        if self.kind == "circle":
            return named == hidden or (not named and self.hidden[0] in self.blind)
        return named == hidden and not self.unnamed


def jobs(kind: str, seeds: int) -> Iterator[Job]:
    """Logs of one kind."""
    for seed in range(1, seeds + 1):
        if kind in ("none", "dirty"):
            yield Job(kind, {}, seed, dirty=kind == "dirty")
        elif kind == "pairs":
            first, second = np.random.default_rng([77, seed]).choice(NAMED, 2, replace=False)
            yield Job(kind, realistic(str(first), seed) | realistic(str(second), seed + 1000), seed)
        else:
            names: Iterable[str] = {"outside": OUTSIDE, "forms": tuple(FORMS)}.get(kind, NAMED)
            for name in names:
                hidden = realistic(name, seed, 0.25 if kind == "weak" else 1.0)
                yield Job(kind, hidden, seed, "circle" if kind == "circle" else "rich")


def work(job: Job) -> Result:
    """Make one log and search it."""
    log = simulated_drive(job.hidden, job.seed, job.drive, job.dirty)
    began = time.process_time()
    report = find_gap(log, MODEL)
    cpu_s = time.process_time() - began
    mm = {stage: 1e3 * errors[2.0].position_m for stage, errors in report.gap.items()}
    errors, covered = [], []
    for effect in report.effects:
        given = job.hidden.get(effect.name)
        if given is None or isinstance(given, tuple):
            continue
        estimate = list(effect.parameters.values())[-1]
        errors.append(abs(estimate.value / given - 1.0))
        covered.append(estimate.low <= given <= estimate.high)
    return Result(
        job.kind, list(job.hidden), job.seed, [effect.name for effect in report.effects],
        [term.form for term in report.unnamed], len(report.residue),
        [spot.name for spot in report.blind_spots if spot.blind],
        mm["refitted"], mm["amended"], mm["floor"], errors, covered, cpu_s,
    )  # fmt: skip


def run(todo: list[Job], processes: int, dask: str | None) -> Iterator[Result]:
    """Results as they come, on all cores or on a dask cluster."""
    if dask is not None:
        # Only who has a cluster has dask.
        from dask.distributed import Client, as_completed  # noqa: PLC0415

        with Client(dask) as client:
            for future in as_completed(client.map(work, todo, pure=False)):
                yield future.result()
        return
    with get_context("spawn").Pool(processes) as pool:
        yield from pool.imap_unordered(work, todo)


def summary(results: list[Result]) -> dict[str, float]:
    """Figures by kind."""
    figures: dict[str, float] = {}
    for kind in KINDS:
        of = [result for result in results if result.kind == kind]
        if not of:
            continue
        figures[f"gap.{kind}.logs"] = len(of)
        figures[f"gap.{kind}.right"] = float(np.mean([result.right for result in of]))
        figures[f"gap.{kind}.cpu_s"] = float(np.median([result.cpu_s for result in of]))
        closed = [
            (r.refitted_mm - r.amended_mm) / (r.refitted_mm - r.floor_mm)
            for r in of
            if r.refitted_mm - r.floor_mm > 1.0
        ]
        if closed:
            figures[f"gap.{kind}.closed_median"] = float(np.median(closed))
        errors = [error for result in of for error in result.errors]
        if errors:
            figures[f"gap.{kind}.parameter_error_median"] = float(np.median(errors))
            figures[f"gap.{kind}.coverage"] = float(np.mean([c for result in of for c in result.covered]))
    return figures


def confusion(results: list[Result]) -> tuple[list[str], list[str], np.ndarray]:
    """Rows: hidden, columns: named (and unnamed, nothing), counts over the logs with one thing hidden."""
    of = [result for result in results if result.kind in ("single", "outside", "none")]
    rows = [*[name for name in (*NAMED, *OUTSIDE) if any(r.hidden == [name] for r in of)], "nothing"]
    columns = [*NAMED, "unnamed", "nothing"]
    counts = np.zeros((len(rows), len(columns)), dtype=int)
    for result in of:
        row = rows.index(result.hidden[0] if result.hidden else "nothing")
        found = [*result.named, *(["unnamed"] if result.unnamed else [])] or ["nothing"]
        for name in found:
            counts[row, columns.index(name)] += 1
    return rows, columns, counts


def write(results: list[Result], out: Path) -> None:
    """Figures, table and picture."""
    out.mkdir(parents=True, exist_ok=True)
    content = {"figures": summary(results), "results": [asdict(result) for result in results]}
    (out / "gap_study.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    rows, columns, counts = confusion(results)
    lines = ["| hidden | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, row in zip(rows, counts, strict=True):
        lines.append(f"| {name} | " + " | ".join(str(count) if count else "" for count in row) + " |")
    (out / "gap_confusion.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    figure = Figure(figsize=(9, 0.32 * len(rows) + 3))
    axes = figure.add_subplot()
    axes.imshow(counts / np.maximum(counts.sum(axis=1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xlabel("named")
    axes.set_ylabel("hidden")
    for y, x in np.argwhere(counts > 0):
        share = counts[y, x] / counts[y].sum()
        axes.text(x, y, str(counts[y, x]), ha="center", va="center", color="white" if share > 0.5 else "black")
    figure.savefig(out / "gap_confusion.png", dpi=110, bbox_inches="tight")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap_study", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} (all)")
    parser.add_argument("--seeds", type=int, default=10, help="logs of each hidden effect (10)")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="processes (all cores)")
    parser.add_argument("--dask", metavar="ADDRESS", help="scheduler of a dask cluster to run on instead")
    parser.add_argument("-o", "--out", type=Path, default=Path("gap_study"), help="directory to write to")
    options = parser.parse_args()
    unknown = set(options.kinds) - set(KINDS)
    if unknown:
        parser.error(f"no such kind: {', '.join(sorted(unknown))}; write some of {', '.join(KINDS)}")
    todo = [job for kind in options.kinds or KINDS for job in jobs(kind, options.seeds)]
    console = Console()
    results = []
    for result in track(run(todo, options.processes, options.dask), "searching", len(todo), console=console):
        results.append(result)
        if not result.right:
            console.print(f"{result.kind} {result.hidden} seed {result.seed}: named {result.named} {result.unnamed}")
        write(results, options.out)
    for key, value in summary(results).items():
        console.print(f"{key:<40} {value:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
