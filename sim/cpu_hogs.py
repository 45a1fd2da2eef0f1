"""Busy processes that take the processor away from others, as a fault."""

from __future__ import annotations

import subprocess
import sys
from types import TracebackType

from sim.fault_schedule import Fault

# A child of a real-time process would be one itself.
_BUSY = "import os; os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))\nwhile True: pass"


class CpuHogs:
    """Starts and ends busy processes at normal priority; satisfies `sim.fault_player.ProcessFaults` for `cpu_hog`."""

    def __init__(self) -> None:
        self._busy: dict[int, list[subprocess.Popen[bytes]]] = {}

    def __enter__(self) -> CpuHogs:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number in tuple(self._busy):
            self._stop(number)

    def begin(self, fault: Fault) -> None:
        """Start one process for each core."""
        if fault.kind.name == "cpu_hog":
            command = [sys.executable, "-S", "-c", _BUSY]
            self._busy[fault.number] = [subprocess.Popen(command) for _ in range(fault["cores"])]

    def end(self, fault: Fault) -> None:
        """End them."""
        self._stop(fault.number)

    def _stop(self, number: int) -> None:
        for process in self._busy.pop(number, []):
            process.kill()
            process.wait()
