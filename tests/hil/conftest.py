"""A test in real time that fails while the host of this virtual machine holds it up is tried once more.

What the host takes of the processors stops robot, daemon and test alike, and the robot's watchdog then ends the drive,
as it must: that says nothing of the code. Nothing else is tried again.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from _pytest.runner import runtestprotocol

from disco_hw import processes

STALL_MS = 100
"""Of all processors together, within half a second; a robot hears nothing for no longer than 100 ms."""
PERIOD_S, LOOKS = 0.05, 10


@contextmanager
def most_taken() -> Iterator[list[int]]:
    """The most that the host took within LOOKS periods, in ms: one entry, there after the block."""
    most: list[int] = []
    ended = threading.Event()

    def watch() -> None:
        said = deque([processes.stolen_ms()], LOOKS + 1)
        worst = 0
        while not ended.wait(PERIOD_S):
            said.append(processes.stolen_ms())
            worst = max(worst, said[-1] - said[0])
        most.append(max(worst, processes.stolen_ms() - said[0]))

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield most
    finally:
        ended.set()
        thread.join()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    with most_taken() as most:
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    if most[0] >= STALL_MS and any(report.failed and report.when == "call" for report in reports):
        item.warn(pytest.PytestWarning(f"tried once more: the host took {most[0]} ms of the processors at once"))
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
