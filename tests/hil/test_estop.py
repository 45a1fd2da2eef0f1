"""`disco-hw estop` stops the robot whatever state the daemon is in; the stop latches until a person resets it."""

from __future__ import annotations

import os
import signal
import time

import pytest

from disco_hw.errors import WorkError
from tests.hil.stack import STATIONARY_RAD_S, disco, disco_json
from tools.stack import TruthRow, running_stack, write_robot_file

pytestmark = pytest.mark.hil


def latch_and_reset(stack, daemon: str) -> float:
    """Stop the driving robot with `disco-hw estop` and reset it; when the command had replied (s)."""
    if daemon == "frozen":
        # The firmware's watchdog stops the robot by itself then; the e-stop must latch all the same.
        os.kill(stack.daemon.process.pid, signal.SIGSTOP)
    robot_file = stack.robot_file
    if daemon == "healthy":
        # No more of robot.toml is needed than where the link is.
        text = robot_file.read_text().replace("wheel_radius_m = 0.06", 'wheel_radius_m = "round"')
        robot_file = stack.directory / "broken.toml"
        robot_file.write_text(text)
        assert "round" in text
    code, outcome = disco_json("estop", str(robot_file))
    replied_s = time.monotonic()
    if daemon == "frozen":
        os.kill(stack.daemon.process.pid, signal.SIGCONT)
    assert code == 0, outcome
    assert outcome["link_error"] is None
    assert outcome["confirmed"]
    stack.operator.wait_for("FAULT", 3.0)
    with pytest.raises(WorkError, match="refused to arm"):
        stack.operator.request("arm")
    time.sleep(0.6)
    stack.operator.request("reset")
    stack.operator.wait_for("READY", 5.0)
    # The daemon hears the frames of `disco-hw estop` on a bus that all share.
    output = stack.daemon.output_lines()
    assert "another host is on the link" not in output
    if daemon == "healthy" and 'kind = "can"' in text:
        assert output.count("e-stop received on the link") == 1
    return replied_s


def assert_latched(rows: list[TruthRow], replied_s: float) -> None:
    """The robot was in ESTOP, and its wheels stand from half a second after the reply on."""
    assert any(row.state == "ESTOP" for row in rows)
    assert max(row.fastest for row in rows if row.t_s > replied_s + 0.5) < STATIONARY_RAD_S


# tests/hil/test_sudden_loss.py has a healthy daemon on CAN.
@pytest.mark.parametrize(
    ("daemon", "link"),
    [
        ("frozen", "serial"),
        pytest.param("healthy", "serial", marks=pytest.mark.long),
        pytest.param("frozen", "can", marks=pytest.mark.long),
    ],
)
def test_estop_stops_and_latches(tmp_path, link, daemon):
    with running_stack(tmp_path, link=link) as stack:
        stack.drive()
        replied_s = latch_and_reset(stack, daemon)
        assert_latched(stack.truth(), replied_s)


def test_estop_without_a_robot_says_so_and_fails(tmp_path):
    code, output = disco("estop", str(write_robot_file(tmp_path)))
    assert code == 1
    assert "NOT SENT" in output
    assert "Traceback" not in output
