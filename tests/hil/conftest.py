"""A test in real time that fails while the host of this virtual machine, or its kernel, holds it up is tried once more.

Then robot, daemon and test are stopped alike, and the robot's watchdog ends the drive, as it must: that says nothing of
the code. Nothing else is tried again.
"""

from __future__ import annotations

import shutil
import tempfile
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

from disco_hw import processes
from tests.watched_processors import build_watcher, watched_processors

STALL_MS = 100
"""Of all processors together, within half a second; a robot hears nothing for no longer than 100 ms."""
PERIOD_S, LOOKS = 0.05, 10
WATCH_US, LEAST_US = 5_000, 50_000
FOLDER = tempfile.TemporaryDirectory(prefix="watched-")


@cache
def watcher() -> Path | None:
    """What tells of pauses; None where it cannot be compiled or be above everything else."""
    return build_watcher(Path(FOLDER.name)) if shutil.which("cc") and processes.can_use_fifo() else None


@contextmanager
def longest_pause_ms() -> Iterator[list[int]]:
    """Yield a list for how long (ms) this machine held up what ran, with one entry after the block.

    The longest time for which a processor ran nobody, or the most that the host took within LOOKS periods.
    """
    most: list[int] = []
    ended = threading.Event()
    worst = 0

    def watch() -> None:
        nonlocal worst
        stolen_ms = deque([processes.stolen_ms()], LOOKS + 1)
        while not ended.wait(PERIOD_S):
            stolen_ms.append(processes.stolen_ms())
            worst = max(worst, stolen_ms[-1] - stolen_ms[0])

    program, thread = watcher(), threading.Thread(target=watch)
    watching = nullcontext(list) if program is None else watched_processors(program, program.parent, WATCH_US, LEAST_US)
    with watching as paused:
        thread.start()
        try:
            yield most
        finally:
            ended.set()
            thread.join()
            most.append(max(worst, *((to - since) // 1_000_000 for since, to in paused()), 0))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with longest_pause_ms() as most:
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    if most[0] >= STALL_MS and any(report.failed and report.when == "call" for report in reports):
        item.warn(pytest.PytestWarning(f"tried once more: this machine ran nothing for {most[0]} ms"))
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
