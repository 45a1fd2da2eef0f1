"""Run test vectors of vendors' protocols through the drivers' codecs and the simulators.

`python -m tools.vectors.check DIR`

A vector file is called as its protocol and holds one case a line; the format is said in the README beside the files.
Prints how many cases of each file agree, how many of those within rounding, and every disagreement. Exits 1 if there
is one, 2 if there is nothing to run.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

from tools.vectors import agilex, odrive, roboclaw, vesc
from tools.vectors.comparison import Case, Comparison

CHECKS: dict[str, Callable[[Case], Comparison]] = {
    "odrive056": odrive.check_05,
    "odrive06": odrive.check_06,
    "vesc_can": vesc.check_can,
    "vesc_uart": vesc.check_uart,
    "roboclaw": roboclaw.check,
    "agilex_v2": agilex.check,
}


def check_case(check: Callable[[Case], Comparison], line: str) -> tuple[str, Comparison]:
    """Run one line of a file; a case that cannot be read or run disagrees."""
    name = "a line"
    try:
        case = json.loads(line)
        name = str(case["case"])
        return name, check(case)
    except Exception as error:  # a case that breaks the tool is a case that does not agree
        return name, Comparison([f"cannot be run: {type(error).__name__}: {error}"])


def main(arguments: list[str]) -> int:
    """Check every file of the folder named; return the exit status."""
    if len(arguments) != 1 or not Path(arguments[0]).is_dir():
        print("usage: python -m tools.vectors.check DIR, the folder with the *.jsonl files", file=sys.stderr)
        return 2
    files = sorted(Path(arguments[0]).glob("*.jsonl"))
    known = [path for path in files if path.stem in CHECKS]
    disagree = 0
    for path in files:
        if path.stem not in CHECKS:
            print(f"{path.name}: no driver here speaks this protocol; not run")
            continue
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        results = [check_case(CHECKS[path.stem], line) for line in lines]
        wrong = [(name, found) for name, found in results if found.differences]
        rounded = sum(found.rounded for _, found in results if not found.differences)
        disagree += len(wrong)
        print(f"{path.name}: {len(results) - len(wrong)} of {len(results)} agree, {rounded} of them within rounding")
        for name, found in wrong:
            for difference in found.differences:
                print(f"  {name}: {difference}")
    if not known:
        print(f"{arguments[0]}: no vectors; their files are called {', '.join(CHECKS)} with .jsonl", file=sys.stderr)
        return 2
    return 1 if disagree else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
