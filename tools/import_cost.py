"""CPU seconds until a command is under way or has refused a wrong file: the least of some runs each, as a table."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import disco_hw

RUNS = 5
ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"


def cpu_s(arguments: list[str]) -> float:
    """CPU time of a process, user and system, to its end."""
    with tempfile.TemporaryFile() as nothing:
        process = subprocess.Popen([sys.executable, *arguments], stdout=nothing, stderr=nothing)
        _, _, used = os.wait4(process.pid, 0)
    return used.ru_utime + used.ru_stime


def main() -> None:
    robot, command = str(ROBOT), ["-m", "disco_hw"]
    rows = {
        "python and numpy": ["-c", "import numpy"],
        "ctl, no daemon": [*command, "ctl", robot, "status"],
        "estop, no robot": [*command, "estop", robot],
        "run, no such robot.toml": [*command, "run", "none.toml"],
        "run, no such model": [*command, "run", robot, "--model", "none.toml"],
        "replay, no such log": [*command, "replay", "none.mcap"],
        "infer, no such log": [*command, "infer", "none.mcap", "--robot", robot],
        "import of run": ["-c", "import disco_hw.daemon.daemon"],
        "import of check": ["-c", "import disco_hw.daemon.check"],
    }
    for name, arguments in rows.items():
        print(f"{name:26} {min(cpu_s(arguments) for _ in range(RUNS)):6.2f} s", flush=True)


if __name__ == "__main__":
    main()
