"""Without a robot `run` says what it waits for, and `ctl status` and `check` say the same."""

import signal
import time
from contextlib import ExitStack

import pytest

from disco_hw.experiments import Operator, disco_hw_process
from tests.hil.stack import disco_here
from tests.hil.test_refusals import assert_check_fails, assert_refused, other_firmware
from tools.stack import write_robot_file

pytestmark = pytest.mark.hil


def lines_of(daemon, until, timeout_s=240.0):
    """What the daemon has said, once that satisfies a condition."""
    deadline = time.monotonic() + timeout_s
    while not until(lines := daemon.output.read_text().splitlines()):
        assert time.monotonic() < deadline, lines
        assert daemon.process.poll() is None, lines
        time.sleep(0.05)
    return lines


def test_without_a_robot_it_says_what_it_waits_for_and_then_refuses_a_firmware_that_does_not_fit(tmp_path):
    robot, log = write_robot_file(tmp_path), tmp_path / "run.mcap"
    with (
        ExitStack() as stack,
        disco_hw_process("daemon", ["run", str(robot), "--log", str(log)], tmp_path / "daemon.txt") as daemon,
    ):
        lines = lines_of(daemon, lambda lines: sum(line.startswith("state: DISCONNECTED") for line in lines) >= 3)
        (waits_for,) = {line for line in lines if line.startswith("state: DISCONNECTED")}
        why = "nothing listens there; start the other end first"
        assert why in waits_for
        assert waits_for.endswith("Check the robot's power and the cable to it.")
        assert f"log: recording to {log}" in lines
        assert any(line.startswith("next: ") and f"`disco-hw ctl {robot} arm`" in line for line in lines)
        _, status = disco_here("ctl", str(robot), "status")
        assert status.splitlines()[0] == waits_for.removeprefix("state: ").split(". Check")[0]
        assert status.splitlines()[1] == "next: Check the robot's power and the cable to it."
        stack.enter_context(other_firmware(tmp_path, "dbc_hash=0x12345678"))
        assert_refused(Operator(tmp_path / "control.sock", (daemon,)), ["12345678"])
        daemon.process.send_signal(signal.SIGTERM)
        assert daemon.process.wait(60.0) == 0
        assert daemon.last_line() == f"log: look at it: disco-hw view {log}, or disco-hw log info {log}"
        assert_check_fails(robot, ["12345678"])
    _, report = disco_here("check", str(robot))
    assert f"fail  link: {status.splitlines()[0].removeprefix('DISCONNECTED: ')}" in report
