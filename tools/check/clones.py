"""`make test` in fresh clones of HEAD, one after the other, each with the conditions that it ran under.

`python -m tools.check.clones 10 --busy 5` is ten, the last five beside four busy processes. It exits with 1 if one
failed or took longer than `--most` seconds; those beside busy processes may take `--more` seconds longer.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from disco_hw.processes import stolen_ms

COUNT = re.compile(r"\d+ (?:passed|failed|skipped|errors?)")
BUSY_PROCESSES = 4
# What would have the clone use this checkout's modules or compiled kernels.
OF_THIS_CHECKOUT = ("PYTHONPATH", "NUMBA_CACHE_DIR", "VIRTUAL_ENV", "MAKEFLAGS")


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one clone; `load` is the machine's over a minute, before and after."""

    code: int
    wall_s: float
    cpu_s: float
    load: tuple[float, float]
    stolen_s: float
    output: str

    def describe(self) -> str:
        lines = self.output.splitlines()
        counts = ", ".join(COUNT.findall(" ".join(lines[-3:]))) or "no counts"
        notable = [line for line in lines if line.startswith(("FAILED", "ERROR", "E  ", "make test took", "!!!"))]
        first = (
            f"rc {self.code}, {self.wall_s:.0f} s wall, {self.cpu_s:.0f} s CPU, {counts}, load {self.load[0]:.1f} "
            f"before and {self.load[1]:.1f} after, the host stole {self.stolen_s:.1f} s"
        )
        return "\n  ".join([first, *(notable or (lines[-10:] if self.code else []))])


def run(command: list[str], folder: Path) -> Outcome:
    """Run a command to its end; its processes count where they were waited for."""
    environment = {name: value for name, value in os.environ.items() if name not in OF_THIS_CHECKOUT}
    load, stolen, begin_s, used_s = os.getloadavg()[0], stolen_ms(), time.monotonic(), _children_cpu_s()
    done = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    wall_s, cpu_s, stolen_s = time.monotonic() - begin_s, _children_cpu_s() - used_s, (stolen_ms() - stolen) * 1e-3
    return Outcome(done.returncode, wall_s, cpu_s, (load, os.getloadavg()[0]), stolen_s, done.stdout)


def _children_cpu_s() -> float:
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Run `count` processes that do nothing but compute, for the block."""
    made = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in made:
            process.kill()
            process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("clones", type=int)
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="run the last N beside busy processes")
    parser.add_argument("--most", type=float, default=math.inf, metavar="S", help="seconds that one may take")
    parser.add_argument("--more", type=float, default=0.0, metavar="S", help="seconds more beside busy processes")
    options = parser.parse_args()
    codes: list[int] = []
    for number in range(1, options.clones + 1):
        busy_processes = BUSY_PROCESSES if number > options.clones - options.busy else 0
        with tempfile.TemporaryDirectory(prefix="clone") as folder, busy(busy_processes):
            subprocess.run(["git", "clone", "-q", ".", folder], check=True)
            outcome = run(["make", "test"], Path(folder))
        is_too_slow = outcome.wall_s > options.most + bool(busy_processes) * options.more
        codes.append(outcome.code or int(is_too_slow))
        print(
            f"{number} of {options.clones}{f', beside {busy_processes} busy processes' * bool(busy_processes)}: "
            f"{outcome.describe()}{', too long' * is_too_slow}",
            flush=True,
        )
    print(f"{codes.count(0)} of {options.clones} passed")
    return int(any(codes))


if __name__ == "__main__":
    raise SystemExit(main())
