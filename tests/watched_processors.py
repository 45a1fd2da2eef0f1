"""When the processors ran nobody, as programs tell that sleep on each of them above everything else."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from disco_hw.processes import can_use_fifo

BARE_LOOP = Path(__file__).parents[1] / "tools" / "check" / "bare_loop.c"
Pauses = list[tuple[int, int]]


def build_watcher(folder: Path) -> Path:
    """Compile the program."""
    program = folder / "watch"
    subprocess.run(["cc", "-std=c99", "-O2", "-o", str(program), str(BARE_LOOP)], check=True)
    return program


@contextmanager
def watched_processors(program: Path, folder: Path, period_us: int, least_us: int) -> Iterator[Callable[[], Pauses]]:
    """The program on each processor, sleeping for a period at a time.

    Yields a function that tells when they were not run for longer than `least_us`: from when to when, ns, on any of
    them. The computer's own host has done that, or its kernel; no program of ours can.
    """
    with ExitStack() as stack:
        paths: list[Path] = []
        for processor in sorted(os.sched_getaffinity(0)):
            paths.append(folder / f"paused-{processor}")
            sink = stack.enter_context(paths[-1].open("wb"))
            command = [str(program), str(period_us), "99" if can_use_fifo() else "0", str(processor), str(least_us)]
            watch = stack.enter_context(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=sink))
            stack.callback(watch.kill)

        def paused() -> Pauses:
            lines = [line.split() for path in paths for line in path.read_text().splitlines()]
            return sorted((int(since), int(to)) for since, to in lines)

        yield paused
