"""`make gap-study`: how often the search for missing effects is right, on simulated robots with something hidden.

Writes `gap_study.json`, the tables `gap_confusion.md` and the confusion matrix as a picture, `gap_confusion.png`.
Results are kept in the output directory, log by log, for this state of the code: a study that was broken off goes on
where it was, one on other code begins anew.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from tools.gap import jobs as gap_jobs
from tools.gap.jobs import KINDS, Job, Result, jobs
from tools.gap.tables import summary, table, write

ROOT = Path(__file__).resolve().parents[2]
JUDGED = (
    "disco_hw/gap", "disco_hw/effects", "disco_hw/model", "disco_hw/log", "disco_hw/drive", "sim",
    "tools/gap/black_box.py", "tools/gap/halves.py", "tools/gap/jobs.py", "tools/gap/logs.py", "tools/gap/mujoco.py",
    "tools/gap/strange_robot.py", "tools/joystick.py", "tools/mujoco_robot.py",
    "tools/simulated_drives.py", "tools/simulated_log.py",
)  # fmt: skip


def revision() -> str:
    """A short hash of all sources that a result depends on."""
    digest = hashlib.sha256()
    for name in JUDGED:
        path = ROOT / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all: a study may be broken off."""
    unfinished = path.with_suffix(".part")
    unfinished.write_text(text, encoding="utf-8")
    unfinished.replace(path)


class Kept:
    """Results on disk, one file a job."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def get(self, job: Job) -> Result | None:
        """The result of a job that was done before."""
        path = self._folder / f"{job.key}.json"
        return Result(**json.loads(path.read_text(encoding="utf-8"))) if path.exists() else None

    def put(self, result: Result) -> None:
        """Keep a result."""
        path = self._folder / f"{'-'.join([result.kind, *result.hidden, str(result.seed)])}.json"
        write_whole(path, json.dumps(asdict(result)))


def run(todo: Sequence[Job], processes: int) -> Iterator[Result]:
    """Results as they come, on some processes."""
    if processes == 1:
        yield from map(gap_jobs.work, todo)
    else:
        with get_context("spawn").Pool(processes) as pool:
            yield from pool.imap_unordered(gap_jobs.work, todo)


def study(todo: Sequence[Job], out: Path, processes: int, console: Console) -> list[Result]:
    """All jobs' results, from before or new; what is written is up to date after every log."""
    code = revision()
    kept = Kept(out / "results" / code)
    found = {job.key: kept.get(job) for job in todo}
    results = [result for result in found.values() if result is not None]
    new = [job for job in todo if found[job.key] is None]
    if results:
        console.print(f"{len(results)} logs were searched before with this code ({code})")
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left:"),
        TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("searching", total=len(todo), completed=len(results))
        for result in run(new, processes):
            kept.put(result)
            results.append(result)
            progress.advance(task)
            if not result.right:
                named = ", ".join([*result.named, *result.unnamed]) or "nothing"
                console.print(f"{result.kind} {' + '.join(result.hidden) or 'nothing'} seed {result.seed}: {named}")
    write(results, out, code)
    return results


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.study", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)} (all)")
    parser.add_argument("--seeds", type=int, default=10, help="logs of each hidden effect (10)")
    parser.add_argument("--first", type=int, default=1, help="first seed (1)")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/gap_study"), help="directory to write to")
    options = parser.parse_args(arguments)
    unknown = set(options.kinds) - set(KINDS)
    if unknown:
        parser.error(f"no such kind: {', '.join(sorted(unknown))}; write some of {', '.join(KINDS)}")
    seeds = range(options.first, options.first + options.seeds)
    todo = [job for kind in options.kinds or KINDS for job in jobs(kind, seeds)]
    results = study(todo, options.out, options.processes, Console(stderr=True))
    print("\n".join(table(results)))
    for key, value in summary(results).items():
        print(f"{key:<40} {value:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
