"""`make bench`: every benchmark of the project in one run on one machine; prints a table and writes bench.json."""

from __future__ import annotations

import importlib
import json
import os
import platform
import signal
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

PARTS = (
    "bench_adapt",
    "bench_bridge",
    "bench_control",
    "bench_control_path",
    "bench_estimation",
    "bench_import",
    "bench_inference",
    "bench_latency",
    "bench_log",
    "bench_loop",
    "bench_start",
    "bench_tracking",
    "bench_viewer",
    "bench_wire",
)


def main() -> int:
    figures: dict[str, float] = {}
    console = Console()
    for part in sys.argv[1:] or PARTS:
        console.print(f"[bold]{part}[/bold]")
        found = importlib.import_module(f"tools.{part}").run()
        table = Table(show_header=False)
        for key, value in found.items():
            table.add_row(key, f"{value:.4g}")
        console.print(table)
        figures |= found
    result = {
        "machine": {
            "cpu": _cpu(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "load": os.getloadavg()[0],
        },
        "figures": figures,
    }
    Path("bench.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    console.print(f"{len(figures)} figures in bench.json")
    return 0


def _cpu() -> str:
    for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


if __name__ == "__main__":
    # So that whoever breaks it off leaves no robot, daemon or node running.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    raise SystemExit(main())
