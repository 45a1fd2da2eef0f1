"""However the daemon ends, the wheels come first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from disco_hw.experiments import Child
from disco_hw.log.reader import open_log
from tests.hil.stack import STATIONARY_RAD_S
from tools.stack import running_stack

pytestmark = pytest.mark.hil


# That each signal ends the loop is tested without a robot (tests/daemon/test_signals.py), and quitting while the robot
# drives by tests/hil/test_recording.py, too.
@pytest.mark.parametrize(
    "how",
    [
        signal.SIGTERM,
        pytest.param(signal.SIGINT, marks=pytest.mark.long),
        pytest.param("quit", marks=pytest.mark.thorough),
    ],
)
def test_a_signal_or_a_request_to_quit_stops_the_wheels_before_the_process_ends(tmp_path, how):
    with running_stack(tmp_path) as stack:
        stack.drive()
        if how == "quit":
            stack.operator.request("quit")
        else:
            os.kill(stack.daemon.process.pid, how)
        code = stack.daemon.process.wait(60.0)
        ended_s = time.monotonic()
        time.sleep(0.3)
        rows = stack.truth()
    assert code == 0
    before = [row for row in rows if row.t_s < ended_s]
    assert max(row.fastest for row in before) > 5.0
    assert before[-1].fastest < STATIONARY_RAD_S
    assert before[-1].state in {"STANDBY", "READY"}
    with open_log(tmp_path / "run.mcap") as log:
        assert log.summary().complete


# No valid control for the 100 calls after the 60th, which are two seconds, and an exception 60 plans after that.
FAILING = """
import sys
from disco_hw.control import Disco, NoValidControl
plan, count = Disco.plan, 0
def failing(self, now_ns, state):
    global count
    count += 1
    if 60 < count <= 160:
        raise NoValidControl("planted")
    if count > 220:
        raise RuntimeError("planted")
    return plan(self, now_ns, state)
Disco.plan = failing
from disco_hw.cli import main
sys.argv = ["disco-hw", "run", *sys.argv[1:]]
main()
"""


def test_without_a_valid_control_it_follows_the_tail_then_ramps_down_and_an_exception_stops_the_wheels(
    tmp_path, monkeypatch
):
    popen = subprocess.Popen

    def start(arguments, **options):
        failing = [sys.executable, "-c", FAILING, *arguments[4:]]
        return popen(failing if arguments[3] == "run" else arguments, **options)

    monkeypatch.setattr(subprocess, "Popen", start)
    with running_stack(tmp_path) as stack:
        stack.start()
        stack.operator.wait_until("ramping", lambda s: s["source"] == "ramp", 5.0)
        status = stack.operator.wait_for_standstill(3.0)
        standing_s = time.monotonic()
        assert status["state"] == "ARMED"
        code = stack.daemon.process.wait(60.0)
        time.sleep(1.2)
        rows = stack.truth()
        output = (tmp_path / "daemon.txt").read_text()
    with open_log(tmp_path / "run.mcap") as log:
        commands = log.columns("/command")
    sources = [str(source) for source in commands["source"]]
    first, ramp = sources.index("tail"), sources.index("ramp")
    assert sources[first - 1] == "plan"
    assert set(sources[first:ramp]) == {"tail"}
    # By the ticks' times: a machine that is held up leaves ticks out.
    since_ns = commands["t_ns"].astype(np.int64) - int(commands["t_ns"][first - 1])
    assert since_ns[ramp - 1] <= 200_000_000 < since_ns[ramp]
    assert code == 1
    assert "RuntimeError: planted" in output
    # How fast it has become by the exception is not this test's matter.
    assert max(row.fastest for row in rows if row.t_s > standing_s) > 2.0
    last_command = next(row for row in rows if row.accepted == rows[-1].accepted)
    assert all(row.fastest < STATIONARY_RAD_S for row in rows if row.t_s > last_command.t_s + 0.75)


def test_child_helper_reports_last_words(tmp_path):
    output = tmp_path / "out.txt"
    output.write_text("one\ntwo\n")
    assert Child("x", None, output).last_line() == "two"
