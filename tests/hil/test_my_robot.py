"""The tutorial for a robot of one's own, followed to the letter at a terminal, with each simulated controller.

What is the reader's is put in place of the page's words in capitals and of its link. Every command and every key that
is pressed counts, a key that is held as one.
"""

from __future__ import annotations

import math
import os
import re
import signal
import socket
import sys
import time
import tomllib
from contextlib import contextmanager
from pathlib import Path

import pytest

from disco_hw.config import load_robot_config
from disco_hw.daemon import send_request, socket_path
from disco_hw.errors import WorkError
from disco_hw.experiments import disco_hw_process, link_of_device
from tests.hil.test_commission import Terminal
from tools.stack import write_robot_file

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "my-robot.md").read_text("utf-8")
DRIVERS = ("reference", "odrive", "vesc", "agilex", "roboclaw")
MOST_KEYS = 60
MEASURES = {"radius of": "0.06", "left to right": "0.31", "encoder ticks": "2048", "fastest speed": "8"}
"""What `init` asks, in its order, and of the virtual robot the answers."""
PATIENCE_S = 900.0
TYPED = (
    "disco-hw init -o ROBOT.toml --link can:socketcan:can0",
    "disco-hw check ROBOT.toml",
    "disco-hw commission ROBOT.toml",
    "disco-hw drive ROBOT.toml --script excite --log drive.mcap",
    "disco-hw infer drive.mcap --robot ROBOT.toml -o model.toml",
    "disco-hw gap drive.mcap --robot ROBOT.toml --model model.toml -o out/gap",
    "disco-hw run ROBOT.toml --model out/gap/model.toml",
    "disco-hw ctl ROBOT.toml arm",
    "disco-hw ctl ROBOT.toml start",
    "disco-hw estop ROBOT.toml",
)


def commands_of_the_page():
    blocks = re.findall(r"^```sh\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return [re.sub(r"\s+#.*", "", line) for block in blocks for line in block.splitlines()]


def test_the_page_has_the_commands_that_are_followed():
    assert tuple(commands_of_the_page()) == TYPED


def lines_for_robot_toml():
    """What the page has its reader write into robot.toml, for poses by datagrams."""
    (block,) = re.findall(r"^```toml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    section, *lines = block.splitlines()
    assert section == "[pose]"
    return lines


class Reader:
    """Sits before the virtual robot, reads the page from its top and types; counts commands and keys."""

    def __init__(self, directory, driver):
        self.directory, self.driver = directory, driver
        self.left = commands_of_the_page()
        self.commands = self.keys = 0
        self.hidden = directory / "hidden"
        self.hidden.mkdir()
        self.device = write_robot_file(self.hidden, link_of_device(driver) if driver != "reference" else "can", device=(
            None if driver == "reference" else driver
        ))  # fmt: skip
        self.robot_file = directory / "robot.toml"

    @property
    def link(self):
        link = tomllib.loads(self.device.read_text("utf-8"))["link"]
        if link["kind"] == "serial":
            return f"serial:{link['port']}"
        return f"can:{link['interface']}:{link['channel']}"

    @contextmanager
    def type(self, line, *, again=False, may_fail=False):
        """The page's next command in a terminal, or that of before `again`; it has to end well unless it `may_fail`."""
        assert again or self.left.pop(0) == line
        self.commands += 1
        arguments = line.replace("ROBOT.toml", "robot.toml").replace("can:socketcan:can0", self.link).split()
        terminal = Terminal([sys.executable, "-m", "disco_hw", *arguments[1:]], self.directory)
        try:
            yield terminal
            terminal.pump(lambda _output: terminal.process.poll() is not None, PATIENCE_S)
            code = terminal.process.wait(10.0)
            assert code == 0 or may_fail, f"{line}: {terminal.output_lines[-3000:]}"
        finally:
            terminal.process.kill()
            terminal.process.wait()
            os.close(terminal.master)

    def run(self, line):
        with self.type(line) as terminal:
            pass
        return terminal.output_lines

    def check(self):
        """Typed anew where nothing failed but the round trip: a busy computer holds up the one that answers."""
        for again in (False, True, True, True, True):
            with self.type(TYPED[1], again=again, may_fail=True) as terminal:
                pass
            if re.findall(r"^fail +([^:]+):", terminal.output_lines, re.MULTILINE) != ["round trip"]:
                break
        assert terminal.process.returncode == 0, terminal.output_lines

    def press(self, terminal, keys):
        self.keys += len(keys)
        terminal.type(keys)

    @contextmanager
    def holding(self, terminal):
        self.keys += 1
        terminal.holding = True
        yield
        terminal.holding = False

    def wheels(self):
        """The true speeds of the wheels, seen by eye (rad/s)."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asking:
            mine = self.hidden / "eye"
            asking.bind(str(mine))
            try:
                asking.settimeout(10.0)
                asking.sendto(b"state", str(self.hidden / "inject"))
                row = asking.recv(4096).decode().split(",")
            finally:
                mine.unlink()
        return float(row[4]), float(row[5])

    def reply(self, terminal, prompt, keys):
        """Rest the hands a moment, as whoever lets go of a key to press another does."""
        terminal.wait(prompt, PATIENCE_S)
        terminal.holding = False
        terminal.pause(0.7)
        self.press(terminal, keys)

    def settings(self):
        """The robot.toml that `init` asks for and writes."""
        with self.type(TYPED[0]) as terminal:
            if self.driver == "roboclaw":
                self.reply(terminal, "[y/n]", "y\n")
            for prompt, value in MEASURES.items():
                self.reply(terminal, prompt, value + "\n")
        assert tomllib.loads(self.robot_file.read_text("utf-8"))["link"]["driver"] == self.driver, terminal.output_lines
        if self.driver != "reference":
            self.write_poses()

    def write_poses(self):
        port = tomllib.loads(self.device.read_text("utf-8"))["pose"]["port"]
        written = self.robot_file.read_text("utf-8")
        for line in lines_for_robot_toml():
            name = line.split("=")[0].strip()
            if re.search(rf"^\[pose\]\n{name} = ", written, re.MULTILINE):
                continue
            mine = re.sub(r"= \d+", f"= {port}", line).strip()
            self.keys += len(mine) + 1
            written = written.replace("[pose]\n", f"[pose]\n{mine}\n")
        self.commands += 1
        self.robot_file.write_text(written, encoding="utf-8")

    def first_drive(self):
        with self.type(TYPED[2]) as terminal:
            self.reply(terminal, "press Enter", "\n")
            for side, key in (("left", "1"), ("right", "3")):
                terminal.wait(f"the {side} side speeds up", PATIENCE_S)
                terminal.pause(0.7)
                with self.holding(terminal):
                    terminal.wait(f"the {side} side was commanded forward", PATIENCE_S)
                self.reply(terminal, "", key)
            self.reply(terminal, "press Enter", "\n")
            for side in (0, 1):
                terminal.wait(f"the {('left', 'right')[side]} wheel; hold", PATIENCE_S)
                terminal.pause(0.7)
                with self.holding(terminal):
                    self.until_one_turn(terminal, side)
                self.reply(terminal, "was that one turn", "y")
            terminal.wait("both sides turn", PATIENCE_S)
            terminal.pause(0.7)
            with self.holding(terminal):
                terminal.pump(lambda output: "let go:" in output or "press Enter" in output, PATIENCE_S)
            if "press Enter" not in terminal.output_lines.rsplit("both sides turn", 1)[1]:
                terminal.wait("press Enter", PATIENCE_S)
            terminal.pause(0.7)
            self.press(terminal, "\n")
            terminal.wait("half a metre straight on", PATIENCE_S)
            terminal.pause(0.7)
            with self.holding(terminal):
                terminal.pump(lambda output: "commissioned" in output, PATIENCE_S)
        assert "\nnot commissioned" not in terminal.output_lines

    def until_one_turn(self, terminal, side):
        turned, last_s = 0.0, time.monotonic()
        while abs(turned) < 2.0 * math.pi:
            terminal.pause(0.02)
            now_s = time.monotonic()
            turned, last_s = turned + self.wheels()[side] * (now_s - last_s), now_s

    def drive(self):
        with self.type(TYPED[3]) as terminal:
            terminal.wait("keyboard, 50", PATIENCE_S)
            while terminal.process.poll() is None:
                # Held until it is over; where the repeats were late, let go and held again.
                terminal.pause(0.7)
                with self.holding(terminal):
                    terminal.pump(
                        lambda output: "release all keys" in output[200:] or terminal.process.poll() is not None,
                        PATIENCE_S,
                    )

    def circle(self):
        with self.type(TYPED[6]) as terminal:
            self.until(terminal, lambda status: status["state"] == "READY")
            self.run(TYPED[7])
            self.until(terminal, lambda status: status["state"] == "ARMED")
            self.run(TYPED[8])
            self.until(terminal, lambda status: float(status["task"]["laps"] or 0.0) > 0.5)
            assert "e-stop accepted" in self.run(TYPED[9])
            self.until(terminal, lambda status: status["state"] != "ARMED")
            assert max(map(abs, self.wheels())) < 8.0
            # Ctrl-C: this terminal is not the one that the command was started from.
            self.keys += 1
            terminal.process.send_signal(signal.SIGINT)

    def until(self, terminal, holds):
        deadline_s, status = time.monotonic() + PATIENCE_S, None
        while time.monotonic() < deadline_s:
            terminal.pause(0.3)
            try:
                status = send_request(socket_path(load_robot_config(self.robot_file)), {"do": "status"}, timeout_s=5.0)
            except WorkError:
                continue
            if status.get("ok") and holds(status):
                return
        raise AssertionError(f"{status}\n{terminal.output_lines[-2000:]}")


def follow(directory, driver):
    """The whole page, from its top to its end; the reader."""
    reader = Reader(directory, driver)
    arguments = ["sim", str(reader.device), "--inject", str(reader.hidden / "inject")]
    with disco_hw_process("virtual robot", arguments, directory / "sim.txt") as robot:
        while "ready" not in robot.output.read_text("utf-8"):
            assert robot.process.poll() is None, robot.last_line()
            time.sleep(0.1)
        reader.settings()
        reader.check()
        reader.first_drive()
        reader.drive()
        reader.run(TYPED[4])
        reader.run(TYPED[5])
        reader.circle()
    return reader


@pytest.mark.hil
@pytest.mark.long
@pytest.mark.timeout(5400)
@pytest.mark.parametrize("driver", DRIVERS)
def test_the_tutorial_goes_through_with_less_than_sixty_commands_and_keys(tmp_path, monkeypatch, driver):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    reader = follow(tmp_path, driver)
    assert not reader.left
    print(f"{driver}: {reader.commands} commands, {reader.keys} keys")
    assert reader.commands + reader.keys < MOST_KEYS
