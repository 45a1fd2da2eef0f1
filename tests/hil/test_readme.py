"""The commands of the tutorials and of the README's story, as they stand, in processes of their own."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ROBOT = "disco_hw/robots/wombot.toml"
pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.timeout(5400)]


def commands_under(page: str, heading: str) -> list[list[str]]:
    """The lines of the blocks of commands under a heading that call disco-hw or a program that is the page's."""
    blocks = re.findall(r"^```sh\n(.*?)^```", part_of(page, heading), re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"disco-hw\s|python \w", line)]


def programs_under(page: str, heading: str) -> list[str]:
    """The blocks of Python under a heading."""
    return re.findall(r"^```python\n(.*?)^```", part_of(page, heading), re.MULTILINE | re.DOTALL)


def part_of(page: str, heading: str) -> str:
    """A page from a heading to the next."""
    return (ROOT / page).read_text("utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]


class Reader:
    """Types a page's lines into a terminal; every line has to be there, and each that is there has to be typed."""

    def __init__(self, directory: Path, page: str, heading: str) -> None:
        self._directory = directory
        self.left = commands_under(page, heading)
        # At an address of its own: anybody on this computer may be driving the robot that the shipped file names.
        robots = directory / "disco_hw" / "robots"
        shutil.copytree(ROOT / "disco_hw" / "robots", robots)
        shipped = (robots / "wombot.toml").read_text("utf-8")
        (robots / "wombot.toml").write_text(shipped.replace("/tmp/disco-hw-wombot", str(directory / "wombot")))
        # The folder of the robots is named as the package, and must not be taken for it.
        self._environment = {**os.environ, "XDG_RUNTIME_DIR": str(directory), "PYTHONPATH": str(ROOT)}
        self._background: list[subprocess.Popen] = []

    def _command(self, line: str) -> list[str]:
        program, *arguments = line.split()
        self.left.remove([program, *arguments])
        begin = [sys.executable] if program == "python" else [sys.executable, "-m", "disco_hw"]
        return [*begin, *arguments]

    def type(self, line: str) -> str:
        """Run a command to its end, which must be good."""
        return self.untold(self._command(line))

    def untold(self, command: list[str]) -> str:
        result = subprocess.run(
            command,
            cwd=self._directory,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=1800,
            check=False,
        )
        assert result.returncode == 0, f"{command}: {result.stdout}\n{result.stderr}"
        return result.stdout

    @contextmanager
    def another_terminal(self, line: str):
        """Have a command run beside the others, and end it with Ctrl-C if it has not ended by itself."""
        output = self._directory / "terminal.txt"
        with output.open("ab") as sink:
            process = subprocess.Popen(
                self._command(line), cwd=self._directory, env=self._environment, stdout=sink, stderr=sink
            )
        self._background.append(process)
        try:
            yield process
        finally:
            self._background.remove(process)
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
            try:
                code = process.wait(30)
            finally:
                process.kill()
        assert code == 0, output.read_text("utf-8", errors="replace")

    def ctl(self, *arguments: str) -> str:
        return self.untold([sys.executable, "-m", "disco_hw", "ctl", ROBOT, *arguments])

    def wait(self, what: str, condition, timeout_s: float = 1800.0) -> None:
        deadline_s, status = time.monotonic() + timeout_s, None
        while time.monotonic() < deadline_s and all(process.poll() is None for process in self._background):
            result = subprocess.run(
                [sys.executable, "-m", "disco_hw", "ctl", ROBOT, "status", "--json"],
                cwd=self._directory, env=self._environment, capture_output=True, text=True, timeout=60, check=False,
            )  # fmt: skip
            status = json.loads(result.stdout) if result.returncode == 0 else None
            if status is not None and condition(status):
                return
            time.sleep(0.2)
        ended = [process.args for process in self._background if process.poll() is not None]
        raise AssertionError(f"not {what}: {status}; ended: {ended}")

    def wait_for(self, state: str) -> None:
        self.wait(state, lambda status: status["state"] == state)


def test_the_tutorials_commands_go_through(tmp_path):
    reader = Reader(tmp_path, "docs/virtual-robot.md", "By hand")
    with reader.another_terminal(f"disco-hw sim {ROBOT}"):
        with reader.another_terminal(f"disco-hw run {ROBOT}"):
            reader.wait_for("READY")
            reader.type(f"disco-hw ctl {ROBOT} task radius_m=0.8 speed_m_s=0.3")
            reader.type(f"disco-hw ctl {ROBOT} arm")
            reader.wait_for("ARMED")
            reader.type(f"disco-hw ctl {ROBOT} start")
            reader.wait("turning its wheels", lambda status: status["wheels"] and max(map(abs, status["wheels"])) > 1.0)
            assert "ESTOP" in reader.type(f"disco-hw estop {ROBOT}")
            reader.wait_for("FAULT")
            time.sleep(1.0)
            reader.type(f"disco-hw ctl {ROBOT} reset")
            reader.wait_for("READY")
            reader.type(f"disco-hw ctl {ROBOT} quit")
        reader.type(f"disco-hw drive {ROBOT} --script excite --unattended --log tour.mcap")
        inferred = reader.type(f"disco-hw infer tour.mcap --robot {ROBOT} -o model.toml")
        assert "refuses" not in inferred
        assert "missing_effects" not in (tmp_path / "model.toml").read_text("utf-8")
        with reader.another_terminal(f"disco-hw run {ROBOT} --model model.toml"):
            reader.wait_for("READY")
            reader.ctl("arm")
            reader.wait_for("ARMED")
            reader.ctl("start")
            reader.wait("driving", lambda status: status["wheels"] and max(map(abs, status["wheels"])) > 1.0)
            reader.ctl("stop")
            reader.ctl("quit")
    reader.type("disco-hw log export tour.mcap -o tour.csv")
    reader.type(f"disco-hw import tour.csv --robot {ROBOT} -o imported.mcap")
    assert "ended properly" in reader.type("disco-hw log info tour.mcap")
    assert not reader.left


def test_a_law_of_ones_own_drives_the_virtual_robot(tmp_path):
    page = "docs/my-controller.md"
    reader = Reader(tmp_path, page, "On the robot")
    (tmp_path / "my_controller.py").write_text(programs_under(page, "A controller in DISCO's place")[0], "utf-8")
    (tmp_path / "run_mine.py").write_text(programs_under(page, "On the robot")[0], "utf-8")
    with reader.another_terminal(f"disco-hw sim {ROBOT}"), reader.another_terminal("python run_mine.py"):
        reader.wait_for("READY")
        reader.type(f"disco-hw ctl {ROBOT} arm")
        reader.wait_for("ARMED")
        reader.type(f"disco-hw ctl {ROBOT} start")
        reader.wait("on its way", lambda status: laps(status) > 0.2, 600.0)
        reader.type(f"disco-hw ctl {ROBOT} quit")
    assert "ended properly" in reader.untold([sys.executable, "-m", "disco_hw", "log", "info", "mine.mcap"])
    assert not reader.left


def laps(status) -> float:
    return float(status["task"]["laps"] or 0.0)


def test_what_the_model_misses_is_found_and_driven_with(tmp_path):
    page = "docs/find-what-is-missing.md"
    reader = Reader(tmp_path, page, "The commands")
    only_in_readme = [line for line in commands_under("README.md", "A story in ten lines") if line not in reader.left]
    # Run by tests/hil/test_gap_loop.py, with fewer laps.
    assert only_in_readme == [["disco-hw", "experiment", "gap", "--hide", "deadband=0.8", "-o", "out/story"]]
    with reader.another_terminal(f"disco-hw sim {ROBOT} --hide deadband=0.8"):
        with reader.another_terminal(f"disco-hw run {ROBOT}"):
            reader.wait_for("READY")
            reader.type(f"disco-hw ctl {ROBOT} arm")
            reader.wait_for("ARMED")
            reader.type(f"disco-hw ctl {ROBOT} start")
            reader.wait("on its way", lambda status: laps(status) > 0.1, 600.0)
            reader.type(f"disco-hw ctl {ROBOT} quit")
        reader.type(f"disco-hw drive {ROBOT} --script excite --unattended --log drive.mcap")
        output = reader.type(f"disco-hw gap drive.mcap --robot {ROBOT} -o out/gap")
        assert "deadband" in output
        with reader.another_terminal(f"disco-hw run {ROBOT} --model out/gap/model.toml"):
            reader.wait_for("READY")
            reader.ctl("arm")
            reader.wait_for("ARMED")
            reader.ctl("start")
            reader.wait("round the circle", lambda status: laps(status) > 1.0, 600.0)
            reader.ctl("quit")
    assert not reader.left
    (program,) = programs_under(page, "The same in Python")
    assert re.search(r"deadband \{'width_rad_s': 0\.(79|8|81)\}", reader.untold([sys.executable, "-c", program]))
    assert (tmp_path / "amended.toml").exists()
