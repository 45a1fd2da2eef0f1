"""The demonstration, with its daemon held up for longer than the robot's watchdog waits."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from threading import Timer

import pytest

from disco_hw import demo
from disco_hw.daemon.control_client import send_request
from disco_hw.errors import WorkError

pytestmark = pytest.mark.hil


def daemon():
    """Process id and command line of this process's child that runs `disco-hw run`."""
    children = [pid for tasks in Path("/proc/self/task").iterdir() for pid in (tasks / "children").read_text().split()]
    lines = {int(pid): Path(f"/proc/{pid}/cmdline").read_text().split("\0") for pid in children}
    ((pid, line),) = [(pid, line) for pid, line in lines.items() if "run" in line]
    return pid, line


def hold_up(pid, line):
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(pid, signal.SIGCONT)


def disarm(pid, line):
    robot_file = Path(line[line.index("run") + 1])
    assert send_request(robot_file.with_name("control.sock"), {"do": "disarm"}, timeout_s=2.0)["ok"]


class Stolen:
    """Stands for `stolen_ms`: asked first it lets `act` happen to the first daemon, then it says `taken_ms`."""

    def __init__(self, taken_ms, act):
        self._taken_ms = taken_ms
        self._act = act
        self._asked = False

    def __call__(self):
        if self._asked:
            return self._taken_ms
        self._asked = True
        Timer(0.5, self._act, daemon()).start()
        return 0


def test_it_drives_anew_where_the_machines_host_held_the_daemon_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "stolen_ms", Stolen(120, hold_up))
    report = demo.run_demo(demo.DemoOptions(out=tmp_path, laps=0.1))
    said = " ".join(capsys.readouterr().out.split())
    assert report.success
    assert said.count("virtual robot pid") == 2
    assert "the daemon left ARMED for STOPPING" in said
    assert "the host of this virtual machine took 120 ms" in said


@pytest.mark.parametrize(("taken_ms", "act"), [(120, disarm), pytest.param(90, hold_up, marks=pytest.mark.long)])
def test_whatever_else_stops_it_ends_it(tmp_path, monkeypatch, capsys, taken_ms, act):
    monkeypatch.setattr(demo, "stolen_ms", Stolen(taken_ms, act))
    with pytest.raises(WorkError, match="left ARMED for STOPPING"):
        demo.run_demo(demo.DemoOptions(out=tmp_path, laps=0.1))
    assert capsys.readouterr().out.count("virtual robot pid") == 1
