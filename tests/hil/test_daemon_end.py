"""However the daemon ends, the wheels come first."""

from __future__ import annotations

import os
import signal
import time
from contextlib import contextmanager

import numpy as np
import pytest

from disco_hw.experiments import Child
from disco_hw.log.reader import open_log
from tests.hil.stack import STATIONARY_RAD_S
from tools.stack import running_stack

pytestmark = pytest.mark.hil


# That each signal ends the loop is tested without a robot (tests/daemon/test_signals.py).
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.long)])
def test_a_signal_stops_the_wheels_before_the_process_ends(tmp_path, number):
    with running_stack(tmp_path) as stack:
        stack.drive()
        os.kill(stack.daemon.process.pid, number)
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


# tests/hil/test_recording.py quits while the robot drives, too.
@pytest.mark.thorough
def test_quit_stops_the_wheels_too(tmp_path):
    with running_stack(tmp_path) as stack:
        stack.drive()
        stack.operator.request("quit")
        assert stack.daemon.process.wait(60.0) == 0
        ended_s = time.monotonic()
        rows = stack.truth()
    assert next(row for row in reversed(rows) if row.t_s < ended_s).fastest < STATIONARY_RAD_S


FAILING = """
import sys
from disco_hw.control import Disco
plan, count = Disco.plan, 0
def failing(self, now_ns, state):
    global count
    count += 1
    if count > 60:
        raise {error}("planted")
    return plan(self, now_ns, state)
Disco.plan = failing
from disco_hw.cli import main
sys.argv = ["disco-hw", "run", *sys.argv[1:]]
main()
"""


@contextmanager
def daemon_that_fails(monkeypatch, error: str):
    """Start the daemon from a script in which planning fails after 60 plans."""
    import subprocess
    import sys

    import disco_hw.experiments as operator_module

    popen = subprocess.Popen

    def start(arguments, **options):
        if arguments[3] == "run":
            arguments = [sys.executable, "-c", FAILING.format(error=error), *arguments[4:]]
        return popen(arguments, **options)

    monkeypatch.setattr(operator_module.subprocess, "Popen", start)
    yield
    monkeypatch.undo()


def test_an_exception_in_the_loop_stops_the_wheels_and_is_reported(tmp_path, monkeypatch):
    error = "RuntimeError"
    with daemon_that_fails(monkeypatch, error), running_stack(tmp_path) as stack:
        stack.start()
        code = stack.daemon.process.wait(60.0)
        time.sleep(1.2)
        rows = stack.truth()
        output = (tmp_path / "daemon.txt").read_text()
    assert code == 1
    assert f"{error}: planted" in output
    # 60 plans are 1.2 s; how fast it has become by then is not this test's matter.
    assert max(row.fastest for row in rows) > 2.0
    last_command = next(row for row in rows if row.accepted == rows[-1].accepted)
    assert all(row.fastest < STATIONARY_RAD_S for row in rows if row.t_s > last_command.t_s + 0.75)


def test_a_planner_without_a_valid_control_follows_the_tail_then_ramps_down(tmp_path, monkeypatch):
    no_valid_control = "__import__('disco_hw.control').control.NoValidControl"
    with daemon_that_fails(monkeypatch, no_valid_control), running_stack(tmp_path) as stack:
        stack.start()
        stack.operator.wait_until("ramping", lambda s: s["source"] == "ramp", 5.0)
        status = stack.operator.wait_for_standstill(3.0)
        assert status["state"] == "ARMED"
        stack.truth()
    with open_log(tmp_path / "run.mcap") as log:
        commands = log.columns("/command")
    sources = [str(source) for source in commands["source"]]
    first, last = sources.index("tail"), len(sources) - 1 - sources[::-1].index("tail")
    assert sources[first - 1] == "plan"
    assert set(sources[first : last + 1]) == {"tail"}
    assert sources[last + 1] == "ramp"
    # By the ticks' times: a machine that is held up leaves ticks out.
    since_ns = commands["t_ns"].astype(np.int64) - int(commands["t_ns"][first - 1])
    assert since_ns[last] <= 200_000_000 < since_ns[last + 1]


def test_child_helper_reports_last_words(tmp_path):
    output = tmp_path / "out.txt"
    output.write_text("one\ntwo\n")
    assert Child("x", None, output).last_line() == "two"
