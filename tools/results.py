"""`python -m tools.results bench.json`: keeps measured figures, and writes the last part of docs/results.md.

    make bench PARTS=bench_wire && python -m tools.results bench.json
    disco-hw demo --json > demo.json && python -m tools.results demo.json --shown-by "disco-hw demo --json"
    python -m tools.results            # only writes the page again, from the figures that are kept

What is kept is in docs/figures.json: for each command its newest run, with the date, the state of the code and the
machine. Any file with {"figures": {name: number}} will do: bench.json and the studies write one; and so will what a
command has printed for its --json. The rest of the page, what was noted in words, is written by hand and stays.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "results.md"
KEPT = ROOT / "docs" / "figures.json"
_QUANTILE = re.compile(r"(.+)\.(p\d+(?:\.\d+)?)")
BEGIN, END = "<!-- begin: written by `python -m tools.results` -->", "<!-- end -->"


def machine() -> dict[str, Any]:
    """Return the conditions of a measurement: the day (UTC), the state of the code, processor, cores, Python, load."""
    changed = _git("status", "--porcelain", "--untracked-files=no")
    return {
        "date": datetime.now(UTC).strftime("%d %b %Y"),
        "commit": _git("rev-parse", "--short", "HEAD") + ("+" if changed else ""),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 2),
    }


def runs_of(content: Mapping[str, Any], shown_by: str | None) -> dict[str, dict[str, Any]]:
    """The runs that a file holds, by the command that makes each: one for each part of a bench, else one alone.

    Raises ValueError where there are no figures, or no command is known.
    """
    figures = dict(_numbers(content.get("figures") or ({} if "parts" in content else content)))
    if not figures:
        raise ValueError('no figures: it takes a file with {"figures": {name: number}}, or what a --json has printed')
    about = content.get("machine") or {
        **machine(),
        **({"commit": content["revision"]} if "revision" in content else {}),
    }
    took_s: dict[str, float] = {}
    if "parts" in content:
        parts = {f"make bench PARTS={part}": names for part, names in content["parts"].items()}
        took_s = {f"make bench PARTS={part}": seconds for part, seconds in content.get("took_s", {}).items()}
    elif shown_by:
        parts = {shown_by: list(figures)}
    else:
        raise ValueError("--shown-by: which command makes this file?")
    runs = {
        command: {
            **about,
            **({"took_s": took_s[command]} if command in took_s else {}),
            "figures": {name: figures[name] for name in names if name in figures},
        }
        for command, names in parts.items()
    }
    return {command: run for command, run in runs.items() if run["figures"]}


def _numbers(content: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Every finite number in nested tables, by the names on the way to it joined by dots; lists are left out."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            yield f"{prefix}{name}", value


def measured(kept: Mapping[str, Mapping[str, Any]]) -> str:
    """Return Markdown with a table for each command, the quantiles of one figure in one row."""
    lines: list[str] = []
    for command, run in sorted(kept.items()):
        where = f"{run['date']}, `{run['commit']}`, {run['cpu']}, {run['cores']} cores, Python {run['python']}"
        before = f"load {run['load_before']:g} before and " if "load_before" in run else "load "
        took = f" It took {run['took_s']:.0f} s." if "took_s" in run else ""
        lines += [
            f"### `{command}`",
            "",
            f"{where}, {before}{run['load']:g} at the end.{took}",
            "",
            "| figure | value |",
            "|---|---|",
        ]
        rows: dict[str, list[str]] = {}
        for name, value in run["figures"].items():
            one = _QUANTILE.fullmatch(name)
            rows.setdefault(one[1] if one else name, []).append(f"{one[2]} {value:.4g}" if one else f"{value:.4g}")
        lines += [f"| `{name}` | {', '.join(values)} |" for name, values in rows.items()]
        lines.append("")
    return "\n".join(lines).strip() or "Nothing yet."


def written(page: str, kept: Mapping[str, Mapping[str, Any]]) -> str:
    """The page with its part of printed figures anew. Raises ValueError if the page has no place for it."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"no place for the figures: a line {BEGIN} and, below, a line {END}")
    return f"{before}{BEGIN}\n\n{measured(kept)}\n\n{END}{after}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.results", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE.json", help="figures to keep")
    parser.add_argument("--shown-by", metavar="COMMAND", help="the command that made them, where it is no bench")
    given = parser.parse_args(arguments)
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
    for file in given.files:
        try:
            kept |= runs_of(json.loads(file.read_text(encoding="utf-8")), given.shown_by)
        except (OSError, ValueError) as error:
            print(f"{file}: {error}", file=sys.stderr)
            return 2
    KEPT.write_text(json.dumps(dict(sorted(kept.items())), indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), kept), encoding="utf-8")
    print(f"{sum(len(run['figures']) for run in kept.values())} figures of {len(kept)} commands in {PAGE.name}")
    return 0


def _git(*arguments: str) -> str:
    result = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    return result.stdout.strip() or ("" if arguments[0] == "status" else "unknown")


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


if __name__ == "__main__":
    raise SystemExit(main())
