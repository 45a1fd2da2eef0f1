"""What each threshold and each rule of the search for missing effects is good for, on the tuning set.

    DISCO_HW_DATA=FOLDER python -m tools.gap.ablation [--rules] [--each N] [--logs N] [NAME ...] -o out/gap_ablation

Each log of `tools.gap.tuning` is searched as usual, and once more to see which thresholds would decide otherwise at
half or at double (`tools.gap.margins`). Then thresholds are halved and doubled: those that would decide nothing
otherwise all at once, the others eight at a time. Where an answer is another, the thresholds that make it are found by
bisection. One that made another answer in `--each` logs (1) is left as it is in the further logs. Another answer:
other names or doubts, another model offered, an interval that holds or loses the truth, or an error of the offered
model that is two per cent larger or smaller. With `--rules` it is counted how often each rule of `tools.gap.rules`
decides, and each log is searched once more without each rule that does. `--validate` searches the validation set as
usual, nothing else.

A search that was broken off goes on from `gap_ablation.json`; `gap_ablation.md` has the table.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from tools.gap.tuning import TUNING, VALIDATION, TuningLog, tuning_logs  # first: it sets the threads

# isort: split
import numpy as np

from disco_hw import gap
from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings
from tools.gap.margins import FACTORS, watched
from tools.gap.rules import RULES, counting, without
from tools.gap.study import write_whole

USUAL = "usual"
# Errors of the offered model, over those of `timed`, that differ by less are alike.
LEAST_CHANGE = 0.02
AT_ONCE = 8
SAID = ("named", "unnamed", "doubtful", "offered")
# No thresholds: sizes of vectors, and numbers of the normal distribution.
DEFINITIONS = ("BASE_COUNT", "STATES", "Z95", "_RISE", "_ONE_SIGMA", "_GAUSSIAN_KURTOSIS")


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


def settings_fields() -> list[str]:
    """Every field of the settings, as GROUP.NAME."""
    return [
        f"{group.name}.{one.name}"
        for group in fields(DEFAULT_SETTINGS)
        for one in fields(getattr(DEFAULT_SETTINGS, group.name))
    ]


def module_numbers() -> list[str]:
    """Every number that a module of `disco_hw.gap` other than the settings holds, as MODULE:NAME."""
    folder, out = Path(gap.__file__).parent, []
    for path in sorted(folder.rglob("*.py")):
        parts = ("disco_hw.gap", *path.relative_to(folder).with_suffix("").parts)
        module = ".".join(part for part in parts if part != "__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign) and module != "disco_hw.gap.settings":
                value = getattr(importlib.import_module(module), getattr(node.targets[0], "id", ""), None)
                if isinstance(value, (int, float)) and node.targets[0].id not in DEFINITIONS:  # type: ignore[attr-defined]
                    out.append(f"{module}:{node.targets[0].id}")  # type: ignore[attr-defined]
    return out


@contextmanager
def changed(names: Iterable[str], times: float) -> Iterator[GapSettings]:
    """Hold numbers of modules at a factor, and give the settings with their fields at it."""
    groups: dict[str, dict[str, Any]] = {}
    with ExitStack() as stack:
        for name in names:
            module_name, _, constant = name.partition(":")
            if constant:
                module = importlib.import_module(module_name)
                usual = getattr(module, constant)
                stack.callback(setattr, module, constant, usual)
                setattr(module, constant, scaled(usual, times))
                continue
            group, _, setting = name.partition(".")
            value = scaled(getattr(getattr(DEFAULT_SETTINGS, group), setting), times)
            if value is not None:
                groups.setdefault(group, {})[setting] = value
        parts = {group: replace(getattr(DEFAULT_SETTINGS, group), **values) for group, values in groups.items()}
        yield replace(DEFAULT_SETTINGS, **parts)


def alike(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two searches of a log say the same, predict as well, and have intervals that hold the same truths."""
    if "error" in one:
        return False
    said = [{name: value for name, value in each["answer"].items() if name in SAID} for each in (one, other)]
    near = np.abs(np.log(np.array(one["over_timed"]) / other["over_timed"])) < LEAST_CHANGE
    return bool(said[0] == said[1] and one["held"] == other["held"] and near.all())


class Ablation:
    """Results by log: the usual search, margins by threshold, and searches with something changed, kept in a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.by_log: dict[str, dict[str, Any]] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def of(self, log: TuningLog) -> dict[str, Any]:
        """All that is known of a log, after it was searched as usual."""
        if log.key not in self.by_log:
            self.keep(log.key, {"variants": {USUAL: asdict(log.search())}})
        return self.by_log[log.key]

    def keep(self, key: str, more: Mapping[str, Any]) -> None:
        """Add to what is known of a log, and write it."""
        self.by_log.setdefault(key, {}).update(more)
        write_whole(self.path, json.dumps(self.by_log))

    def search(self, log: TuningLog, key: str, names: Iterable[str], times: float) -> bool:
        """Search a log with thresholds at a factor; whether it is answered as usual."""
        variants = self.of(log)["variants"]
        if key not in variants:
            try:
                with changed(names, times) as settings:
                    variants[key] = asdict(log.search(settings))
            except (ArithmeticError, ValueError, IndexError, TypeError, np.linalg.LinAlgError) as error:
                variants[key] = {"error": f"{type(error).__name__}: {error}"}
            self.keep(log.key, {"variants": variants})
            print(f"{log.key}: {key}", file=sys.stderr, flush=True)
        return alike(variants[key], variants[USUAL])

    def margins(self, log: TuningLog) -> dict[str, list[int]]:
        """How often half or double of each threshold flips a comparison, or is lost from sight; 0 and 0: never."""
        known = self.of(log)
        if "margins" not in known:
            settings, margins = watched()
            found = asdict(log.search(settings))
            assert alike(found, known["variants"][USUAL]), log.key
            names = {
                name: [margins.compared[name], margins.flipped[name], margins.lost[name]] for name in margins.compared
            }
            self.keep(log.key, {"margins": names})
        return dict(self.of(log)["margins"])

    def screen(self, log: TuningLog, names: Sequence[str], times: float) -> list[str]:
        """Which of some thresholds change the answer at a factor, found by bisection."""
        if not names or self.search(log, f"{' '.join(names)} x{times:g}", names, times):
            return []
        if len(names) == 1:
            return list(names)
        middle = len(names) // 2
        return [*self.screen(log, names[:middle], times), *self.screen(log, names[middle:], times)]

    def thresholds(self, log: TuningLog, names: Sequence[str]) -> None:
        """Search a log with thresholds at half and at double."""
        margins = self.margins(log)
        if "changes" in self.of(log):
            return
        may = [name for name in names if any(margins.get(name, (0, 0, 0))[1:])]
        groups = [
            [name for name in names if name not in may],
            *(may[k : k + AT_ONCE] for k in range(0, len(may), AT_ONCE)),
        ]
        changes = {
            f"{times:g}": [name for group in groups for name in self.screen(log, group, times)] for times in FACTORS
        }
        self.keep(log.key, {"changes": changes, "searched": list(names)})

    def deciding(self, name: str) -> int:
        """Number of logs in which half or double of a threshold changes the answer."""
        every = [log["changes"] for log in self.by_log.values() if "changes" in log]
        return sum(any(name in found for found in changes.values()) for changes in every)

    def rules(self, log: TuningLog) -> None:
        """Search a log while the rules' decisions are counted, and without each rule that decides."""
        variants = self.of(log)["variants"]
        if "rules" not in self.of(log):
            with counting() as counts:
                log.search()
            self.keep(log.key, {"rules": counts})
        for name, (_, otherwise) in self.of(log)["rules"].items():
            if otherwise and name not in variants:
                with without(name):
                    variants[name] = asdict(log.search())
                self.keep(log.key, {"variants": variants})
                print(f"{log.key}: without: {name}", file=sys.stderr, flush=True)


def table(by_log: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """One line for each rule and threshold, over the logs in which it changes the answer, the usual in brackets."""
    yield "| rule or threshold | may decide in | changes | names right | error over timed | intervals hold | CPU, s |"
    yield "|---|---|---|---|---|---|---|"
    every = [log for log in by_log.values() if USUAL in log.get("variants", {})]
    usual = [log["variants"][USUAL] for log in every]
    figures = f"{_right(usual)} | {_ratio(usual):.3f} | {_held(usual)} | {_cpu_s(usual):.1f}"
    yield f"| {USUAL} | {len(every)} logs | | {figures} |"
    for rule in RULES:
        known = [log for log in every if "rules" in log]
        may = sum(log["rules"][rule.name][1] > 0 for log in known)
        yield f"| {rule.name} | {may} of {len(known)} | {_changed(every, rule.name)} |"
    for name in (*settings_fields(), *module_numbers()):
        known = [log for log in every if name in log.get("searched", ())]
        may = sum(any(log["margins"].get(name, (0, 0, 0))[1:]) for log in known)
        for times in FACTORS:
            yield f"| {name} x{times:g} | {may} of {len(known)} | {_changed(every, f'{name} x{times:g}')} |"


def _changed(every: Sequence[Mapping[str, Any]], key: str) -> str:
    """Return the cells of a line: what a change did in the logs that it answers otherwise."""
    own = [(log["variants"][key], log["variants"][USUAL]) for log in every if key in log["variants"]]
    other = [pair for pair in own if not alike(*pair)]
    failed = sum("error" in one for one, _ in other)
    pairs = [pair for pair in other if "error" not in pair[0]]
    cells = f"{len(other)}{f' ({failed} fail)' if failed else ''}"
    if not pairs:
        return f"{cells} | | | | "
    ones, usual = zip(*pairs, strict=True)
    return (
        f"{cells} | {_right(ones)} ({_right(usual)}) | {_ratio(ones):.3f} ({_ratio(usual):.3f}) | "
        f"{_held(ones)} ({_held(usual)}) | {_cpu_s(ones):.1f} ({_cpu_s(usual):.1f})"
    )


def _right(found: Sequence[Mapping[str, Any]]) -> str:
    known = [one["right"] for one in found if one["right"] is not None]
    return f"{sum(known)} of {len(known)}"


def _held(found: Sequence[Mapping[str, Any]]) -> str:
    held = [inside for one in found for inside in one["held"]]
    return f"{sum(held)} of {len(held)}"


def _ratio(found: Iterable[Mapping[str, Any]]) -> float:
    """Geometric mean of the offered model's errors over those of `timed`."""
    return float(np.exp(np.mean([np.log(one["over_timed"]) for one in found])))


def _cpu_s(found: Iterable[Mapping[str, Any]]) -> float:
    return float(np.mean([one["cpu_s"] for one in found]))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.ablation", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="thresholds, or beginnings of their names (all)")
    parser.add_argument("--logs", type=int, default=100, help="the first so many of the set (all)")
    parser.add_argument("--each", type=int, default=1, help="logs that show a threshold to matter (1)")
    parser.add_argument("--rules", action="store_true", help="rules switched off, in place of thresholds")
    parser.add_argument("--validate", action="store_true", help="the validation set as usual, nothing else")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/gap_ablation"), help="directory to write to")
    options = parser.parse_args(arguments)
    chosen = [
        name for name in (*settings_fields(), *module_numbers())
        if not options.names or name.startswith(tuple(options.names))
    ]  # fmt: skip
    if not chosen:
        parser.error(f"no threshold begins with {', '.join(options.names)}; see disco_hw/gap/settings.py")
    options.out.mkdir(parents=True, exist_ok=True)
    done = Ablation(options.out / ("gap_validation.json" if options.validate else "gap_ablation.json"))
    logs = tuning_logs(VALIDATION if options.validate else TUNING)[: options.logs]
    for log in logs:
        done.of(log)
        if options.rules:
            done.rules(log)
        elif not options.validate:
            done.thresholds(log, [name for name in chosen if done.deciding(name) < options.each])
    lines = [*table(done.by_log)]
    done.path.with_suffix(".md").write_text("\n".join([*lines, ""]), encoding="utf-8")
    print("\n".join(lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
