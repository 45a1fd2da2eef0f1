"""The demonstration begins in the heading in which the robot goes round, so that it does not swing off its circle."""

import math
import os
import re
import select
import signal
import subprocess
import sys
from types import SimpleNamespace

import pytest

from disco_hw import experiments
from disco_hw.errors import InputError, WorkError
from disco_hw.experiments import Child, Operator, demo
from disco_hw.experiments.demo import start_pose
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from sim.body_dynamics import BodyPose
from tests.daemon.simulated_clock import SimulatedClock
from tests.runtime.simulated import ROBOT_FILE, simulated_stack
from tools.stack import Stack

QUARTER_S = 0.5 * math.pi * 0.75 / 0.2


def test_the_robot_keeps_to_its_circle_from_the_start():
    x_m, y_m, yaw_rad = start_pose(load_setup(ROBOT_FILE))
    assert (x_m, y_m) == (0.75, 0.0)
    stack = simulated_stack(start=BodyPose(x_m, y_m, yaw_rad))
    stack.run(1.5)
    stack.run(0.5, UserRequest.ARM)
    stack.run(0.02, UserRequest.START)
    off_m = []
    for _ in range(round(QUARTER_S / 0.1)):
        stack.run(0.1)
        off_m.append(abs(math.hypot(stack.robot.truth.x_m, stack.robot.truth.y_m) - 0.75))
    assert stack.core.progress.laps > 0.2
    assert max(off_m) < 0.03


def simulated_time(monkeypatch):
    clock = SimulatedClock()
    passing = SimpleNamespace(monotonic=lambda: clock.now_ns() * 1e-9, sleep=lambda s: clock.advance_ns(round(s * 1e9)))
    monkeypatch.setattr(experiments, "time", passing)
    return clock


class Scripted:
    """A daemon's control socket; each request to arm ends in the next of `ends` after a second."""

    def __init__(self, monkeypatch, tmp_path, *ends):
        monkeypatch.setattr(experiments, "send_request", self.respond)
        self.clock, self.ends, self.arming_times_s = simulated_time(monkeypatch), ends, []
        self.path = tmp_path / "control.sock"
        self.path.touch()

    def respond(self, path, request, timeout_s):
        assert path == self.path
        now_s = self.clock.now_ns() * 1e-9
        if request["do"] == "arm":
            self.arming_times_s.append(now_s)
            return {"ok": True}
        over = self.arming_times_s and now_s > self.arming_times_s[-1] + 1.0
        return {"ok": True, "state": self.ends[len(self.arming_times_s) - 1] if over else "READY", "detail": "so"}


def test_an_arming_that_a_busy_machine_ended_is_asked_for_again(monkeypatch, tmp_path):
    daemon = Scripted(monkeypatch, tmp_path, "READY", "READY", "ARMED")
    Operator(daemon.path).arm()
    assert len(daemon.arming_times_s) == 3


@pytest.mark.parametrize(("ends", "attempts"), [(["READY"] * 3, 3), (["READY", "FAULT"], 2)])
def test_an_arming_is_not_asked_for_without_end_and_not_in_a_fault(monkeypatch, tmp_path, ends, attempts):
    daemon = Scripted(monkeypatch, tmp_path, *ends)
    with pytest.raises(WorkError, match=rf"not ARMED within 5 s \({ends[-1]}: so\)"):
        Operator(daemon.path).arm()
    assert len(daemon.arming_times_s) == attempts


class Driven:
    """An operator whose first `failing_drives` drives end for this reason, and all others at speed."""

    def __init__(self, daemon, failing_drives, cause, output_lines):
        self.output, self.failing_drives, self.cause = daemon, failing_drives, cause
        self.output_lines, self.started = output_lines, 0

    def arm(self):
        pass

    def request(self, what):
        self.started += 1
        if self.started <= self.failing_drives:
            self.output.write_bytes(self.output.read_bytes() + self.output_lines)

    def wait_until(self, what, accept, timeout_s):
        fails = self.started <= self.failing_drives
        status = {"state": "READY", "stop_cause": self.cause} if fails else {"state": "ARMED", "stop_cause": "NONE"}
        if not accept(status):
            raise WorkError(f"not {what}")
        return status


@pytest.mark.parametrize(
    ("failing_drives", "cause", "output_lines", "drives"),
    [
        (2, "COMMAND_TIMEOUT", b"", 3),
        (
            2,
            "REQUESTED",
            b"event: armed -> stopping: no wheel data from the robot; check the cable and the robot's power\n",
            3,
        ),
        (1, "REQUESTED", b"event: armed -> stopping: an e-stop\n", None),
        (3, "COMMAND_TIMEOUT", b"", None),
    ],
)
def test_a_drive_that_a_busy_machine_held_up_is_begun_anew(tmp_path, failing_drives, cause, output_lines, drives):
    output = tmp_path / "daemon.txt"
    output.write_bytes(
        b"event: armed -> stopping: no wheel data from the robot; check the cable and the robot's power\n"
    )
    operator = Driven(output, failing_drives, cause, output_lines)
    stack = Stack(tmp_path, tmp_path, None, SimpleNamespace(output_lines=output.read_text), operator, None)
    at_speed = lambda status: status["state"] == "ARMED"  # noqa: E731
    if drives is None:
        with pytest.raises(WorkError, match="not at speed"):
            stack.drive_until("at speed", at_speed, 10.0)
    else:
        assert stack.drive_until("at speed", at_speed, 10.0)["state"] == "ARMED"
        assert operator.started == drives


class Compiling:
    """A daemon that compiles for so many looks at it, and then says nothing."""

    def __init__(self, looks):
        self.name, self.process, self.looks = "daemon", SimpleNamespace(poll=lambda: None), looks

    def last_line(self):
        self.looks -= 1
        return "compiling: 7 functions, 3 s" if self.looks > 0 else "waiting"


def test_the_time_in_which_a_first_start_compiles_does_not_count(tmp_path, monkeypatch):
    simulated_time(monkeypatch)
    daemon = Compiling(looks=20)
    with pytest.raises(WorkError, match=r"not READY within 0.2 s \(compiling: 7 functions, 3 s; .* waiting\)"):
        Operator(tmp_path / "none", (daemon,)).wait_for("READY", 0.2)
    assert daemon.looks <= 0


@pytest.mark.thorough
@pytest.mark.hil
@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.long)])
def test_a_demonstration_that_is_ended_from_outside_leaves_no_process_behind(tmp_path, number):
    command = [sys.executable, "-m", "disco_hw", "demo", "--out", str(tmp_path)]
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    environment = {**os.environ, "TMPDIR": str(scratch)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as demo:
        began = next(found for line in demo.stdout if (found := re.search(r"robot pid (\d+), daemon pid (\d+)", line)))
        children = [os.pidfd_open(int(pid)) for pid in began.groups()]
        demo.send_signal(number)
        assert demo.wait(60) in (-number, 128 + number)
    for child in children:
        assert select.select([child], [], [], 60.0)[0]
        os.close(child)
    assert number is signal.SIGKILL or not list(scratch.iterdir())


@pytest.mark.parametrize(
    ("output", "expected_line"),
    [
        (
            b"page: http://127.0.0.1:8080/?token=abc\nstate: x\n",
            "page http://127.0.0.1:8080/?token=abc (until the drive",
        ),
        (
            b"link: up\npage: --host 127.0.0.1 --port 8080: cannot listen there\npage: the page ended\n",
            "page: --host 127",
        ),
        (b"link: up\npage: http://127.0.0.1:80", "page: no address in "),
    ],
    ids=["served", "another program has the port", "not yet"],
)
def test_an_address_is_shown_only_if_the_page_itself_has_said_it(monkeypatch, tmp_path, output, expected_line):
    """Whoever listens on the port may be another program, to which the token must not be given."""
    clock = SimulatedClock()
    passing = SimpleNamespace(monotonic=lambda: clock.now_ns() * 1e-9, sleep=lambda s: clock.advance_ns(round(s * 1e9)))
    monkeypatch.setattr(demo, "time", passing)
    daemon = Child("daemon", None, tmp_path / "daemon.txt")
    daemon.output.write_bytes(output)
    assert demo.page_line(daemon).startswith(expected_line)


def test_a_wrong_token_is_refused_before_anything_is_started(monkeypatch, tmp_path):
    monkeypatch.setenv("DISCO_HW_PAGE_TOKEN", "abc")
    with pytest.raises(InputError, match="DISCO_HW_PAGE_TOKEN: give 16 or more"):
        demo.run_demo(demo.DemoOptions(out=tmp_path, view=True))
    assert not list(tmp_path.iterdir())
