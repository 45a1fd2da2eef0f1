"""`disco-hw commission` at a terminal, with a person played by a program: keys held, let go, and answers."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import sys
import time

import pytest

from tests.hil.stack import virtual_robot
from tools.stack import write_robot_file

pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.timeout(400)]
_REPEAT_S = 0.03
_RELEASE_S = 0.8
_RELEASE_PROMPTS = ("release all keys", "release the deadman", "release it and press")
"""What is said to whose key came too late: they let go and hold again."""


class Terminal:
    """Reads what the command says and types; a key held repeats as a terminal's does."""

    def __init__(self, command, cwd):
        self.master, slave = pty.openpty()
        self.process = subprocess.Popen(
            command, cwd=cwd, stdin=slave, stdout=slave, stderr=slave, start_new_session=True
        )
        os.close(slave)
        self.output_lines, self.holding, self._next_s = "", False, 0.0

    def pump(self, until, timeout_s=120.0):
        """Read, and repeat the key that is held, until `until` of what was said since this call; that text."""
        begin, deadline_s = len(self.output_lines), time.monotonic() + timeout_s
        while not until(self.output_lines[begin:]):
            assert time.monotonic() < deadline_s, self.output_lines[-2000:]
            if select.select([self.master], [], [], _REPEAT_S / 2)[0]:
                try:
                    fresh = os.read(self.master, 65536).decode(errors="replace")
                except OSError:
                    break
                self.output_lines += fresh
                if any(prompt in fresh for prompt in _RELEASE_PROMPTS):
                    self._next_s = time.monotonic() + _RELEASE_S
            if self.holding and time.monotonic() >= self._next_s:
                self.type(" ")
                self._next_s = time.monotonic() + _REPEAT_S
        return self.output_lines[begin:]

    def type(self, keys):
        os.write(self.master, keys.encode())

    def wait(self, text, timeout_s=120.0):
        return self.pump(lambda output: text in output, timeout_s)

    def pause(self, seconds):
        end_s = time.monotonic() + seconds
        self.pump(lambda _output: time.monotonic() > end_s)


def test_the_first_stage_goes_through_at_a_terminal(tmp_path):
    robot_file = write_robot_file(tmp_path)
    with virtual_robot(robot_file):
        command = [sys.executable, "-m", "disco_hw", "commission", str(robot_file), "--stage", "sides", "--no-write"]
        terminal = Terminal(command, tmp_path)
        try:
            terminal.wait("press Enter")
            terminal.type("\n")
            terminal.wait("the left side speeds up slowly")
            terminal.pause(3.0)
            for side, key in (("left", "1"), ("right", "3")):
                terminal.holding = True
                terminal.wait(f"the {side} side was commanded forward")
                terminal.holding = False
                terminal.pause(0.5)
                terminal.type(key)
                terminal.pause(1.0)
            terminal.wait("commissioned")
            assert terminal.process.wait(20.0) == 0
        finally:
            terminal.process.kill()
            terminal.process.wait()
            os.close(terminal.master)
    assert "begins to turn at a command of" in terminal.output_lines
    assert list(tmp_path.glob("*commission-sides*.mcap")), terminal.output_lines
