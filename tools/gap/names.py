"""Whether a change of the code changes what the search for missing effects answers, to the last bit.

    python -m tools.gap.names BEFORE.json                      # with the code as it was
    python -m tools.gap.names AFTER.json --compare BEFORE.json  # with the code as it is

Sixty simulated logs: every named effect twice, ten with nothing hidden, five with two effects, five with one that is on
no list. Whole reports are kept, and the amended model; a log that was searched already is not searched again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from tools.gap.jobs import MODEL, Job, jobs  # first: it sets the threads of the linear algebra

# isort: split
import numpy as np

from disco_hw.gap import GapReport, find_gap
from disco_hw.gap.report.page import as_text
from disco_hw.log.drive import DriveLog
from tools.gap.logs import LARGEST_RAD_S, simulated_drive


def fixed_jobs() -> list[Job]:
    """The sixty logs, kinds mixed, so that the first few are a fair sample."""
    single = [*jobs("single", (1, 2))]
    other = [*jobs("none", range(1, 11)), *jobs("pairs", range(1, 6)), *jobs("outside", (1,))]
    # Two with something hidden to each other one, in an order that goes through channels and kinds.
    order = np.random.default_rng(0)
    order.shuffle(single)
    order.shuffle(other)
    return [job for k in range(len(other)) for job in (single[2 * k], single[2 * k + 1], other[k])]


def digest(log: DriveLog) -> str:
    """A short hash of all that a log holds."""
    state = hashlib.sha256()
    for group in (log.commands, log.wheels, log.poses, log.gyro):
        for name in group.__dataclass_fields__:
            state.update(np.ascontiguousarray(getattr(group, name)).tobytes())
    return state.hexdigest()[:12]


def answer(log: DriveLog, report: GapReport) -> dict[str, Any]:
    """All that was answered but for the time it took: the report, the amended model, the evidence of candidates."""
    content = {key: value for key, value in report.as_dict().items() if key != "seconds"}
    belief = report.model.belief
    return {
        "log": digest(log),
        "names": [effect.name for effect in report.effects],
        "report": content,
        "text": as_text(report),
        "model": dict(zip(report.model.parameter_names, report.model.point(), strict=True)),
        "belief": None if belief is None else [list(belief.names), belief.mean(), belief.covariance()],
        "candidates": [[one.channel, one.name, one.gain, one.score, one.verdict] for one in report.candidates],
    }


def differences(before: Any, after: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """What differs between two answers: where, what it was and what it is."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        for key in {**before, **after}:
            yield from differences(before.get(key), after.get(key), f"{path}.{key}" if path else str(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for place, (old, new) in enumerate(zip(before, after, strict=True)):
            yield from differences(old, new, f"{path}[{place}]")
    elif before != after and not (_is_nan(before) and _is_nan(after)):
        yield path, before, after


def _relative(old: Any, new: Any) -> float:
    """Difference of two numbers over the larger one; 0 for what is no pair of numbers."""
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in (old, new)):
        return 0.0
    return abs(old - new) / max(abs(old), abs(new))


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def compare(before: Mapping[str, Any], after: Mapping[str, Any], console: Console) -> bool:
    """Print how the answers to the logs in both differ; returns whether none does."""
    shared = [key for key in after if key in before]
    foreign = [key for key in shared if before[key]["log"] != after[key]["log"]]
    named = [key for key in shared if before[key]["names"] != after[key]["names"]]
    unequal, largest = 0, 0.0
    for key in shared:
        found = list(differences(before[key], after[key]))
        largest = max([largest, *(_relative(old, new) for _, old, new in found)])
        unequal += bool(found)
        for path, old, new in found[:8]:
            console.print(f"{key}: {path}: {old!r} -> {new!r}", highlight=False, markup=False, soft_wrap=True)
        if len(found) > 8:
            console.print(f"{key}: and {len(found) - 8} more", markup=False)
    if foreign:
        console.print(f"the logs themselves differ, so nothing follows for: {', '.join(foreign)}", markup=False)
    equal = len(shared) - unequal
    console.print(f"{len(shared)} logs: other names in {len(named)}, equal to the last bit in {equal}")
    console.print(f"largest difference of two numbers: {largest:.2g} of the larger one")
    return not unequal and bool(shared)


def _plain(value: Any) -> Any:
    """A number or an array of numpy as JSON takes it."""
    return value.tolist()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.names", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("out", type=Path, metavar="OUT.json", help="file to write, or to go on with")
    parser.add_argument("--compare", type=Path, metavar="BEFORE.json", help="answers to compare with")
    parser.add_argument("--first", type=int, help="only so many of the logs")
    options = parser.parse_args(arguments)
    console = Console(stderr=True)
    answers = json.loads(options.out.read_text(encoding="utf-8")) if options.out.exists() else {}
    for job in fixed_jobs()[: options.first]:
        if job.key in answers:
            continue
        log = simulated_drive(job.hidden, job.seed)
        found = answer(log, find_gap(log, MODEL, top_rad_s=LARGEST_RAD_S))
        # Through JSON at once: what is compared is what was written.
        answers[job.key] = json.loads(json.dumps(found, default=_plain))
        options.out.write_text(json.dumps(answers), encoding="utf-8")
        console.print(f"{len(answers)}: {job.key}: {', '.join(found['names']) or 'nothing'}", markup=False)
    if options.compare is None:
        return 0
    before = json.loads(options.compare.read_text(encoding="utf-8"))
    return 0 if compare(before, answers, console) else 1


if __name__ == "__main__":
    sys.exit(main())
