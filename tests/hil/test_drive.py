"""Driving by hand with the real virtual robot: a script, a terminal, and what happens when either falls silent."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from disco_hw.drive import INPUT_LIMIT_NS
from disco_hw.experiments import READY_TIMEOUT_S, Operator, disco_hw_process
from disco_hw.log.load import load_drive
from disco_hw.log.reader import open_log
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.replay import replay
from tests.drivers.waiting import wait_until
from tests.hil.stack import DECELERATION_RAD_S2, MOTOR_SETTLING_S, STATIONARY_RAD_S
from tests.hil.test_check import assert_check_passes
from tools.stack import write_robot_file

pytestmark = pytest.mark.hil

# Ticks, the link, and a machine that has other things to do.
MARGIN_S = 0.1
# A key held as on a terminal that repeats 30 times a second, in a process of its own that can be stopped.
TYPIST = """
import os, sys, time
while True:
    os.write(int(sys.argv[1]), sys.argv[2].encode())
    time.sleep(1 / 30)
"""


class Bench:
    """A virtual robot, and `disco-hw drive` on a pseudo-terminal."""

    def __init__(self, directory, stack):
        self.directory, self._stack = directory, stack
        self.robot_file = write_robot_file(directory)
        truth = ["--truth", str(directory / "truth.csv")]
        self.robot = stack.enter_context(
            disco_hw_process("virtual robot", ["sim", str(self.robot_file), *truth], directory / "sim.txt")
        )
        self.log = directory / "run.mcap"
        self.operator = Operator(directory / "control.sock", (self.robot,))

    def drive(self, *arguments, **streams):
        command = [sys.executable, "-m", "disco_hw", "drive", str(self.robot_file), "--log", str(self.log), *arguments]
        process = subprocess.Popen(command, start_new_session=True, **streams)
        self._stack.callback(_end, process)
        return process

    def ready(self):
        """Wait until the robot is ready and the keyboard has been silent for long enough."""
        self.operator.wait_until(
            "ready", lambda s: s["state"] == "READY" and "release" not in s["drive"]["words"], 60.0
        )

    def truth(self):
        """End the robot; its true wheel speeds over time, (N,) and (N, 2)."""
        self._stack.close()
        with (self.directory / "truth.csv").open(newline="", encoding="utf-8") as file:
            rows = [
                (int(row["t_ns"]) * 1e-9, float(row["left_speed_rad_s"]), float(row["right_speed_rad_s"]))
                for row in csv.DictReader(file)
            ]
        found = np.array(rows)
        return found[:, 0], found[:, 1:]


def _end(process):
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@contextmanager
def bench(directory):
    with ExitStack() as stack:
        yield Bench(directory, stack)


@contextmanager
def typing(master, key):
    """Hold a key on the terminal."""
    process = subprocess.Popen([sys.executable, "-c", TYPIST, str(master), key], pass_fds=[master])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def assert_stops_in_time(t_s, wheels, before_s, silent_s):
    """The wheels stand 200 ms plus the deceleration after the last input, and for the rest of the run.

    The input fell silent at some time between `before_s` and `silent_s`.
    """
    size = np.abs(wheels).max(axis=1)
    fastest = size[(t_s > before_s - 0.2) & (t_s <= silent_s)].max()
    assert fastest > 1.5, "the robot was not driving when the input fell silent"
    by_s = silent_s + INPUT_LIMIT_NS * 1e-9 + fastest / DECELERATION_RAD_S2 + MOTOR_SETTLING_S + MARGIN_S
    assert t_s[-1] > by_s + 0.3, "the truth ends too early to judge"
    after = size[t_s > by_s]
    assert after.max() < STATIONARY_RAD_S, f"{after.max()} rad/s"


@pytest.mark.thorough
def test_a_script_is_driven_unattended_and_recorded_as_executed(tmp_path, monkeypatch):
    with bench(tmp_path) as made:
        arguments = ["--script", "steps", "--seed", "1", "--seconds", "14", "--unattended", "--json"]
        process = made.drive(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        reported, complaints = process.communicate(timeout=60)
        assert process.returncode == 0, complaints.decode()
        result = json.loads(reported)
        _, wheels = made.truth()
    assert result["completed"]
    assert result["ended"] == "script steps completed"
    assert result["log"] == str(made.log)
    assert "turn left fast" not in result["coverage"]["missing"]
    drive = load_drive(made.log)
    turn = drive.wheels.right_speed_rad_s - drive.wheels.left_speed_rad_s
    assert (turn > 2.0).sum() > 100
    assert (turn < -2.0).sum() > 50
    # As executed: no step of the command is beyond the limit on acceleration, though the script asks for steps.
    commands = np.column_stack([drive.commands.left_rad_s, drive.commands.right_rad_s])
    given = commands[np.isfinite(commands).all(axis=1)]
    assert np.abs(np.diff(given, axis=0)).max() <= 20.0 * 0.03 + 1e-9
    assert np.abs(wheels[-1]).max() < STATIONARY_RAD_S
    # No plan was made, so the replay needs no planner either, which takes long to compile.
    monkeypatch.setattr("disco_hw.runtime.replay.create_planner", lambda *_: NoPlanner())
    assert replay(made.log).ok
    with open_log(made.log) as log:
        assert {"off", "hold", "manual"} == set(log.columns("/command")["source"])
        reported = [entry.record.text for entry in log.records(["/event"])]
    assert any(text.startswith("step 1") and "found: left -" in text for text in reported)


def test_check_passes_a_key_held_drives_and_a_frozen_typist_stops_the_robot(tmp_path):
    master, slave = os.openpty()
    with bench(tmp_path) as made:
        wait_until(lambda: "ready" in made.robot.output_lines(), READY_TIMEOUT_S)
        assert_check_passes(made.robot_file)
        process = made.drive(stdin=slave, stdout=subprocess.DEVNULL)
        os.close(slave)
        made.ready()
        with typing(master, "w") as typist:
            status = made.operator.wait_until("driving", lambda s: s["drive"]["driving"], 10.0)
            assert status["source"] == "manual"
            made.operator.wait_until("at speed", lambda s: min(s["wheels"]) > 2.5, 5.0)
            before_s = time.monotonic()
            os.kill(typist.pid, signal.SIGSTOP)
            frozen_s = time.monotonic()
            made.operator.wait_for("READY", 5.0)
            # Awake again within what may be a stutter or not: what was held stays open until the key is pressed anew.
            time.sleep(0.3)
            assert made.operator.status()["state"] == "READY"
        time.sleep(0.8)
        # A new hold of the key drives again, backwards; then the program is asked to end.
        with typing(master, "x"):
            made.operator.wait_until("reversing", lambda s: max(s["wheels"]) < -2.0, 10.0)
            os.write(master, b"\x04")
            assert process.wait(60.0) == 0
        t_s, wheels = made.truth()
    os.close(master)
    again_s = t_s[np.flatnonzero((t_s > frozen_s + 0.2) & (wheels.max(axis=1) < -0.2))[0]]
    assert_stops_in_time(t_s[t_s < again_s - 0.1], wheels[t_s < again_s - 0.1], before_s, frozen_s)
    assert np.abs(wheels[-1]).max() < STATIONARY_RAD_S


@pytest.mark.thorough
def test_a_terminal_that_closes_stops_the_robot_and_ends(tmp_path):
    master, slave = os.openpty()
    with bench(tmp_path) as made:
        process = made.drive(stdin=slave, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(slave)
        made.ready()
        with typing(master, "w"):
            made.operator.wait_until("at speed", lambda s: s["drive"]["driving"] and min(s["wheels"]) > 2.5, 10.0)
        before_s = time.monotonic()
        os.close(master)
        closed_s = time.monotonic()
        assert process.wait(60.0) == 1
        time.sleep(1.0)
        t_s, wheels = made.truth()
    assert_stops_in_time(t_s, wheels, before_s, closed_s)
    with open_log(made.log) as log:
        last = log.columns("/daemon/state")["state"][-1]
    assert last == "READY"
