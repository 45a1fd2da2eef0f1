"""CPU time of a command until it is under way, or has answered, or has refused a wrong file.

The least of some runs each, as seconds and as a multiple of what importing numpy takes on the same machine.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile

from disco_hw.config import SHIPPED_ROBOT

RUNS = 5
ROBOT = str(SHIPPED_ROBOT)
COMMAND = ("-m", "disco_hw")
NUMPY = ("-c", "import numpy")
CASES: dict[str, tuple[str, ...]] = {
    "ctl": (*COMMAND, "ctl", ROBOT, "status"),
    "estop": (*COMMAND, "estop", ROBOT),
    "run_no_robot": (*COMMAND, "run", "none.toml"),
    "run_no_model": (*COMMAND, "run", ROBOT, "--model", "none.toml"),
    "replay_no_log": (*COMMAND, "replay", "none.mcap"),
    "infer_no_log": (*COMMAND, "infer", "none.mcap", "--robot", ROBOT),
    "import_run": ("-c", "import disco_hw.daemon.run"),
    "import_check": ("-c", "import disco_hw.daemon.check"),
}


def run(runs: int = RUNS) -> dict[str, float]:
    numpy_s = min(cpu_s(*NUMPY) for _ in range(runs))
    figures = {"start.import_numpy.cpu_s": numpy_s}
    for name, arguments in CASES.items():
        least_s = min(cpu_s(*arguments) for _ in range(runs))
        figures |= {f"start.{name}.cpu_s": least_s, f"start.{name}.over_numpy": least_s / numpy_s}
    return figures


def cpu_s(*arguments: str) -> float:
    """CPU time of a process of Python, user and system, to its end."""
    with tempfile.TemporaryFile() as nothing:
        process = subprocess.Popen([sys.executable, *arguments], stdout=nothing, stderr=nothing)
        _, _, used = os.wait4(process.pid, 0)
    return used.ru_utime + used.ru_stime
