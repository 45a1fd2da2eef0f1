"""The demonstration, with its daemon held up for longer than the robot's watchdog waits."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from threading import Timer

import pytest

from disco_hw.daemon import send_request
from disco_hw.errors import WorkError
from disco_hw.experiments import demo
from tests.drivers.waiting import free_port

pytestmark = pytest.mark.hil
LEFT_ARMED = "the daemon left ARMED for (STOPPING|READY)"


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
    """Stands for `stolen_ms`; asked first, it lets `act` happen to the first daemon after 1.5 s.

    It says 0, `early_ms` from 0.2 s on, and `stolen_ms` more from just before `act` on.
    """

    def __init__(self, stolen_ms, act, early_ms=0):
        self._stolen_ms = stolen_ms
        self._early_ms = early_ms
        self._act = act
        self._reported_ms = None

    def __call__(self):
        if self._reported_ms is None:
            self._reported_ms = 0
            Timer(0.2, self._rise, (self._early_ms,)).start()
            Timer(1.5, self._strike, daemon()).start()
        return self._reported_ms

    def _rise(self, by_ms):
        self._reported_ms += by_ms

    def _strike(self, pid, line):
        self._rise(self._stolen_ms)
        self._act(pid, line)


@pytest.mark.thorough
def test_it_drives_anew_where_the_machines_host_held_the_daemon_up(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "stolen_ms", Stolen(120, hold_up))
    report = demo.run_demo(demo.DemoOptions(out=tmp_path, laps=0.2))
    output = " ".join(capsys.readouterr().out.split())
    assert report.success
    assert output.count("virtual robot pid") == 2
    # Held up for 0.3 s, the daemon comes back just as the wheels come to a stand.
    assert re.search(LEFT_ARMED, output)
    assert "the host of this virtual machine took 120 ms" in output


@pytest.mark.parametrize(
    ("stolen", "act"),
    [
        pytest.param({"stolen_ms": 120}, disarm, marks=pytest.mark.long),
        pytest.param({"stolen_ms": 0, "early_ms": 5000}, hold_up, marks=pytest.mark.thorough),
        pytest.param({"stolen_ms": 90}, hold_up, marks=pytest.mark.long),
    ],
)
def test_whatever_else_stops_it_ends_it(tmp_path, monkeypatch, capsys, stolen, act):
    monkeypatch.setattr(demo, "stolen_ms", Stolen(act=act, **stolen))
    with pytest.raises(WorkError, match=LEFT_ARMED):
        demo.run_demo(demo.DemoOptions(out=tmp_path, laps=0.2))
    assert capsys.readouterr().out.count("virtual robot pid") == 1


@pytest.mark.parametrize(
    ("state", "cause", "is_stall"),
    [
        ("STOPPING", "COMMAND_TIMEOUT", True),
        ("READY", "COMMAND_TIMEOUT", True),
        ("READY", "DISARMED", False),
        ("FAULT", "COMMAND_TIMEOUT", False),
    ],
)
def test_a_stall_is_known_though_the_wheels_stand_at_the_first_status(state, cause, is_stall):
    class Stopped:
        def wait_until(self, what, accept, timeout_s):
            return {"state": "READY", "stop_cause": cause}

    status = {"state": state, "detail": "", "stop_cause": cause}
    assert isinstance(demo._why_stopped(Stopped(), status, 120), demo._HostStallError) is is_stall


@pytest.mark.long
def test_a_pillar_on_the_circle_is_driven_around_in_real_time(tmp_path):
    report = demo.run_demo(demo.DemoOptions(out=tmp_path, laps=0.6, obstacle=True))
    assert report.success
    assert report.left_at_pillar_m > 0.02


@pytest.mark.thorough
def test_the_page_answers_as_soon_as_its_address_is_printed(tmp_path):
    command = [sys.executable, "-m", "disco_hw", "demo", "--view", "--laps", "0.5", "--port", str(free_port())]
    with subprocess.Popen([*command, "--out", str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        try:
            address = next(line.split()[1] for line in process.stdout if line.startswith("page http"))
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            with browser.open(address, timeout=10.0) as response:
                assert response.status == 200
            process.communicate(timeout=120.0)
        finally:
            process.kill()
    assert process.returncode == 0
