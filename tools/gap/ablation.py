"""What each threshold and rule of the search for missing effects is good for, one at a time.

    python -m tools.gap.ablation [GROUP.NAME ...] [--rules] [--logs N] [--jobs N] -o out/gap_ablation

Each log of a small tuning set is searched with the usual settings, and with each threshold at half and at double.
Seeds of the tuning set are 31 on; of the validation set, which no choice looks at, 131 on (`--validate`, usual
settings). A run of the same code that was broken off goes on from `gap_ablation.json`. The table `gap_ablation.md` has
names right, error of the amended model over that of `timed`, intervals that hold the truth, CPU, and how many logs are
answered otherwise in any way. A threshold whose half and double change nothing is none.

With `--rules` each log is searched once while it is counted how often each rule of `tools.gap.rules` answers otherwise
than nothing would, and once more without each rule that did. Where none does, the answer is the same without it.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tools.gap.jobs import Job, Result, jobs, work  # first: it sets the threads of the linear algebra

# isort: split
import numpy as np

from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from tools.gap.rules import RULES, counting, without
from tools.gap.study import revision, write_whole

TUNING, VALIDATION = 31, 131
USUAL = "usual"


@dataclass(frozen=True)
class Variant:
    """One threshold, as GROUP.NAME, and what it is multiplied with; the usual settings have neither."""

    name: str = USUAL
    times: float = 1.0

    @property
    def key(self) -> str:
        """What it is, in the file of results."""
        return self.name if self.name == USUAL else f"{self.name} x{self.times:g}"

    @property
    def settings(self) -> GapSettings | None:
        """The settings with it; None where it is as it was, or is no number."""
        if self.name == USUAL:
            return DEFAULT_SETTINGS
        group_name, _, name = self.name.partition(".")
        group = getattr(DEFAULT_SETTINGS, group_name)
        usual = getattr(group, name)
        value = scaled(usual, self.times)
        if value is None or value == usual:
            return None
        return replace(DEFAULT_SETTINGS, **{group_name: replace(group, **{name: value})})


def scaled(value: Any, times: float) -> Any:
    """A number, or each of several, times a factor; whole numbers stay whole and at least 1. None of anything else."""
    match value:
        case bool():
            return None
        case int():
            return max(round(value * times), 1)
        case float():
            return value * times
        case tuple():
            return tuple(scaled(one, times) for one in value)
    return None


def thresholds() -> list[str]:
    """Every threshold, as GROUP.NAME."""
    return [
        f"{group.name}.{one.name}"
        for group in fields(DEFAULT_SETTINGS)
        for one in fields(getattr(DEFAULT_SETTINGS, group.name))
    ]


def logs(first_seed: int) -> list[Job]:
    """Logs of a set, kinds mixed, so that the first few are a fair sample."""
    every = [*jobs("single", (first_seed,)), *jobs("pairs", range(first_seed, first_seed + 3))]
    np.random.default_rng(0).shuffle(every)  # type: ignore[arg-type]
    none = [*jobs("none", range(first_seed, first_seed + 3))]
    return [every[0], none[0], *every[1:4], none[1], *every[4:8], none[2], *every[8:]]


def search(task: tuple[Variant, Job]) -> tuple[str, str, dict[str, Any]]:
    """What is found in a log with a variant: its key, the log's, and the result."""
    variant, job = task
    settings = variant.settings
    assert settings is not None
    return variant.key, job.key, asdict(work(job, settings))


def searched(todo: Sequence[tuple[Variant, Job]], processes: int) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Results as they come."""
    if processes == 1:
        yield from map(search, todo)
        return
    with get_context("spawn").Pool(processes) as pool:
        yield from pool.imap_unordered(search, todo)


def search_rules(job: Job) -> tuple[str, dict[str, dict[str, Any]], dict[str, list[int]]]:
    """What is found in a log, usually and without each rule that decides anything there, and how often each does."""
    with counting() as counts:
        found = {USUAL: asdict(work(job))}
    for name in (name for name, (_, otherwise) in counts.items() if otherwise):
        with without(name):
            found[name] = asdict(work(job))
    return job.key, found, counts


def rule_table(by_log: Mapping[str, tuple[Mapping[str, dict[str, Any]], Mapping[str, Sequence[int]]]]) -> Iterator[str]:
    """One line for each rule: in how many logs it decides anything, and what is found in these without it."""
    yield "| rule | decides in | names right without it | as usual | amended over timed | as usual | differ |"
    yield "|---|---|---|---|---|---|---|"
    for rule in RULES:
        logs = [log for log, (_, counts) in by_log.items() if counts[rule.name][1]]
        if not logs:
            yield f"| {rule.name} | 0 of {len(by_log)} | | | | | |"
            continue
        usual, own = ({log: by_log[log][0][name] for log in logs} for name in (USUAL, rule.name))
        differ = sum(_answer(own[log]) != _answer(usual[log]) for log in logs)
        yield (
            f"| {rule.name} | {len(logs)} of {len(by_log)} | {_right(own)} | {_right(usual)} | {_ratio(own):.3f} | "
            f"{_ratio(usual):.3f} | {differ} |"
        )


def table(found: Mapping[str, Mapping[str, dict[str, Any]]]) -> Iterator[str]:
    """One line for each variant, over the logs that it was searched with, and the usual settings on the same logs."""
    columns = ("threshold", "logs", "names right", "as usual", "amended over timed", "as usual", "intervals hold")
    yield f"| {' | '.join((*columns, 'CPU, s', 'answered otherwise'))} |"
    yield "|---|---|---|---|---|---|---|---|---|"
    for key, by_log in found.items():
        usual = {log: found[USUAL][log] for log in by_log if log in found[USUAL]}
        own = {log: by_log[log] for log in usual}
        if not own:
            continue
        held = [inside for one in own.values() for inside in one["covered"]]
        differ = sum(_answer(own[log]) != _answer(usual[log]) for log in own)
        yield (
            f"| {key} | {len(own)} | {_right(own)} | {_right(usual)} | {_ratio(own):.3f} | {_ratio(usual):.3f} | "
            f"{sum(held)} of {len(held)} | {np.mean([one['cpu_s'] for one in own.values()]):.1f} | {differ} |"
        )


def _right(by_log: Mapping[str, dict[str, Any]]) -> int:
    return sum(Result(**one).right for one in by_log.values())


def _ratio(by_log: Mapping[str, dict[str, Any]]) -> float:
    """Geometric mean of the amended model's error over that of `timed`."""
    return float(np.exp(np.mean([np.log(one["amended_mm"] / one["timed_mm"]) for one in by_log.values()])))


def _answer(one: Mapping[str, Any]) -> dict[str, Any]:
    """All that was answered but for the time it took."""
    return {name: value for name, value in one.items() if name != "cpu_s"}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.ablation", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="GROUP.NAME", help="thresholds, or beginnings of their names (all)")
    parser.add_argument("--logs", type=int, default=3, help="the first so many of the set (3)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument(
        "--validate", action="store_true", help="the usual settings on the validation set, nothing else"
    )
    parser.add_argument("--rules", action="store_true", help="rules switched off, in place of thresholds")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/gap_ablation"), help="directory to write to")
    options = parser.parse_args(arguments)
    chosen = [name for name in thresholds() if not options.names or name.startswith(tuple(options.names))]
    if not chosen:
        parser.error(
            f"no threshold begins with {', '.join(options.names)}; they are fields of disco_hw/gap/settings.py"
        )
    variants = [Variant()]
    if not options.validate:
        variants += [Variant(name, times) for name in chosen for times in (0.5, 2.0)]
    folder = options.out / revision()
    folder.mkdir(parents=True, exist_ok=True)
    if options.rules:
        return _rules(folder, logs(VALIDATION if options.validate else TUNING)[: options.logs])
    results = folder / ("gap_validation.json" if options.validate else "gap_ablation.json")
    found: dict[str, dict[str, Any]] = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
    todo = [
        (variant, job)
        for job in logs(VALIDATION if options.validate else TUNING)[: options.logs]
        for variant in variants
        if variant.settings is not None and job.key not in found.get(variant.key, {})
    ]
    for count, (key, log, result) in enumerate(searched(todo, options.jobs), 1):
        found.setdefault(key, {})[log] = result
        write_whole(results, json.dumps(found))
        print(f"{count} of {len(todo)}: {key}: {log}", file=sys.stderr, flush=True)
    lines = [*table(found)] if USUAL in found else []
    results.with_suffix(".md").write_text("\n".join([*lines, ""]), encoding="utf-8")
    print("\n".join(lines))
    return 0


def _rules(folder: Path, chosen: Sequence[Job]) -> int:
    """Search with and without rules, log by log; write and print the table."""
    results = folder / "gap_rules.json"
    by_log = json.loads(results.read_text(encoding="utf-8")) if results.exists() else {}
    for count, job in enumerate(chosen, 1):
        if job.key not in by_log:
            key, found, counts = search_rules(job)
            by_log[key] = found, counts
            write_whole(results, json.dumps(by_log))
        print(f"{count} of {len(chosen)}: {job.key}", file=sys.stderr, flush=True)
    lines = [*rule_table(by_log)]
    results.with_suffix(".md").write_text("\n".join([*lines, ""]), encoding="utf-8")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
