"""`make bench`: every benchmark of the project in one run on one machine; prints a table and writes bench.json.

The file is written after each part, so that what is broken off keeps what it has measured.
"""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

PARTS = (
    "bench_adapt",
    "bench_bridge",
    "bench_control",
    "bench_estimation",
    "bench_import",
    "bench_inference",
    "bench_latency",
    "bench_log",
    "bench_start",
    "bench_tracking",
    "bench_viewer",
    "bench_wire",
)
ELSEWHERE = {"bench_tracking": "tools.bench_tracking", "bench_import": "tools.bench.importing"}


def main() -> int:
    parts: dict[str, list[str]] = {}
    figures: dict[str, float] = {}
    took_s: dict[str, float] = {}
    about = machine()
    console = Console()
    for part in sys.argv[1:] or PARTS:
        console.print(f"[bold]{part}[/bold]")
        begin_s = time.monotonic()
        found = importlib.import_module(ELSEWHERE.get(part, f"tools.bench.{part.removeprefix('bench_')}")).run()
        took_s[part] = round(time.monotonic() - begin_s, 1)
        table = Table(show_header=False)
        for key, value in found.items():
            table.add_row(key, f"{value:.4g}")
        console.print(table)
        figures |= found
        parts[part] = list(found)
        result = {
            "machine": {**machine(), "load_before": about["load"]},
            "parts": parts,
            "took_s": took_s,
            "figures": figures,
        }
        Path("bench.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    console.print(f"{len(figures)} figures in bench.json")
    return 0


def machine() -> dict[str, Any]:
    """Return the conditions of a measurement: the day (UTC), the state of the code, processor, cores, Python, load."""
    describe = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--exclude=*", "--dirty=+"]
    processor = re.search(r"^model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    return {
        "date": datetime.now(UTC).strftime("%d %b %Y"),
        "commit": subprocess.run(describe, capture_output=True, text=True, check=False).stdout.strip() or "unknown",
        "cpu": processor[1] if processor else platform.processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 2),
    }


if __name__ == "__main__":
    # So that whoever breaks it off leaves no robot, daemon or node running.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    raise SystemExit(main())
