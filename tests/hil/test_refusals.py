"""Tests of what must not move the robot: wrong files, wrong firmware, garbage and forgeries on the link."""

from __future__ import annotations

import os
import pty
import random
import struct
import subprocess
import sys
import threading
import time
import tty
from contextlib import contextmanager
from pathlib import Path

import can
import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments import READY_TIMEOUT_S, Operator, disco_hw_process
from firmware_protocol.codec import Codec
from tests.drivers.waiting import wait_until
from tests.hil.stack import STATIONARY_RAD_S, disco, disco_here
from tests.runtime.path_robot import path_robot
from tools.stack import read_truth, running_stack, write_robot_file

pytestmark = pytest.mark.hil


@pytest.mark.parametrize(
    ("verb", "old", "new", "field"),
    [
        ("run", "ticks_per_rev = 2048\n", "", "ticks_per_rev"),
        ("check", "wheel_radius_m", "weel_radius_m", "weel_radius_m"),
        ("sim", "rate_hz = 50.0", "rate_hz = 5000.0", "control.rate_hz"),
        ("ctl", 'kind = "can"', "kind = 3", "link.kind"),
    ],
)
def test_a_wrong_robot_file_gets_one_line_and_exit_code_2(tmp_path, verb, old, new, field):
    path = write_robot_file(tmp_path)
    path.write_text(path.read_text().replace(old, new, 1))
    code, output = disco_here(verb, str(path), *(["status"] if verb == "ctl" else []))
    assert code == 2, output
    assert len(output.strip().splitlines()) == 1
    assert str(path) in output
    assert field in output


OTHER_FIRMWARE = """
import sys
from dataclasses import replace
from pathlib import Path
from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import VirtualRobotOptions, run_virtual_robot
firmware = replace(FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0), {change})
sys.exit(run_virtual_robot(VirtualRobotOptions(
    channel=sys.argv[1], firmware=firmware, truth_file=Path(sys.argv[2]), inject=Path(sys.argv[3]))))
"""


@contextmanager
def other_firmware(folder: Path, change: str):
    """A virtual robot whose firmware is configured otherwise, as a process."""
    script = OTHER_FIRMWARE.format(change=change)
    arguments = [sys.executable, "-c", script, str(folder / "bus"), str(folder / "truth.csv"), str(folder / "i")]
    with subprocess.Popen(arguments, stdout=subprocess.DEVNULL) as robot:
        try:
            yield
        finally:
            robot.terminate()


def assert_refused(operator: Operator, fragments: list[str]) -> None:
    """The daemon is in FAULT, with the reason in its words, and does not arm."""
    status = operator.wait_for("FAULT", READY_TIMEOUT_S)
    for fragment in fragments:
        assert fragment in status["detail"]
    with pytest.raises(WorkError, match="refused to arm"):
        operator.request("arm")


def assert_check_fails(robot_file: Path, fragments: list[str]) -> None:
    code, output = disco_here("check", str(robot_file))
    assert code == 1
    for fragment in fragments:
        assert fragment in output


# tests/hil/test_waiting.py has another layout of the messages.
@pytest.mark.long
@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        ("protocol_major=2", ["protocol", "2"]),
        # What is compared with robot.toml, and the words for it, have tests without a robot (tests/runtime).
        ("max_wheel_speed_rad_s=4.0", ["max_wheel_speed_rad_s", "4"]),
        ("ticks_per_rev=1024", ["ticks_per_rev", "1024"]),
    ],
)
def test_a_firmware_that_does_not_fit_is_refused_in_words(tmp_path, change, fragments):
    robot_file = write_robot_file(tmp_path)
    with other_firmware(tmp_path, change):
        with disco_hw_process("daemon", ["run", str(robot_file)], tmp_path / "daemon.txt") as daemon:
            assert_refused(Operator(tmp_path / "control.sock", (daemon,)), fragments)
        assert_check_fails(robot_file, fragments)


def forge(codec: Codec, rng: random.Random, session: int, counter: int) -> tuple[int, bytes]:
    """A wheel command that is wrong in one way, or any frame at all."""
    kind = rng.randrange(6)
    right = codec.encode(
        "WHEEL_COMMAND", counter, mode="SPEED", left_speed=7.0, right_speed=-7.0, valid_for=0.5, session=session
    )
    data = bytearray(right.data)
    match kind:
        case 0:
            data[0] ^= 1 << rng.randrange(8)
        case 1:
            data[rng.randrange(2, 8)] ^= 1 << rng.randrange(8)
        case 2:
            data = data[: rng.randrange(8)]
        case 3:
            other = codec.encode(
                "WHEEL_COMMAND", counter, mode="SPEED", left_speed=7.0, right_speed=-7.0, valid_for=0.5,
                session=(session + 1 + rng.randrange(250)) % 256,
            )  # fmt: skip
            data = bytearray(other.data)
        case 4:
            return rng.randrange(0x800), rng.randbytes(rng.randrange(9))
        case 5:
            return 0x101, rng.randbytes(8)
    return right.can_id, bytes(data)


def assert_others_keep_out(stack):
    """`check`, requests that are refused and a second daemon leave the daemon that drives this robot as it is."""
    code, output = disco_here("check", str(stack.robot_file))
    assert code == 1
    assert "a daemon is connected to this robot" in output
    code, output = disco("ctl", str(stack.robot_file), "status")
    assert code == 0
    assert output.startswith("READY")
    code, output = disco_here("ctl", str(stack.robot_file), "start")
    assert code == 1
    assert "arm it first" in output
    code, output = disco_here("ctl", str(stack.robot_file), "jump")
    assert code == 2
    code, output = disco_here("ctl", str(stack.robot_file), "task", "radius_m=1.25", "speed_m_s=0.25")
    assert (code, "circle of 1.25 m" in output, "0.25 m/s" in output) == (0, True, True), output
    assert stack.operator.status()["task"]["asked"]["radius_m"] == 1.25
    code, output = disco_here("ctl", str(stack.robot_file), "task", "speed_m_s=90")
    assert code == 1
    assert "refused: " in output
    assert stack.operator.status()["task"]["asked"]["speed_m_s"] == 0.25
    code, output = disco("run", str(stack.robot_file))
    assert code == 2
    assert "a daemon already serves this socket" in output


def send_forgeries(stack, frames: int) -> None:
    """Send wheel commands that are wrong in one way each, and any other frames, but no e-stop."""
    rng, codec = random.Random(5), Codec()
    session = int(stack.inject("state").split(",")[13])
    with can.Bus(interface="unixcan", channel=str(stack.directory / "bus")) as bus:
        for n in range(frames):
            can_id, data = forge(codec, rng, session, n % 16)
            if can_id == 0x080:
                continue
            bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False), timeout=1.0)
            time.sleep(0.001)
        while bus.recv(0.0):
            pass
    time.sleep(0.5)


@contextmanager
def recording_of(bus):
    """Yield the list to which all is added that the daemon sends within the block."""
    recorded: list[can.Message] = []
    done = threading.Event()

    def record() -> None:
        while not done.is_set():
            message = bus.recv(0.1)
            if message is not None and message.arbitration_id in {0x100, 0x101, 0x102}:
                recorded.append(message)

    thread = threading.Thread(target=record)
    thread.start()
    try:
        yield recorded
    finally:
        done.set()
        thread.join()


def drive_and_replay(stack) -> tuple[float, float]:
    """Record a drive to the daemon's end and play it back twice; when the drive began and the replay did (s)."""
    with can.Bus(interface="unixcan", channel=str(stack.directory / "bus")) as bus:
        begun_s = time.monotonic()
        with recording_of(bus) as recorded:
            stack.drive()
            stack.operator.request("disarm")
            stack.operator.wait_for("READY", 5.0)
            stack.operator.request("quit")
            stack.daemon.process.wait(60.0)
        ended_s = time.monotonic()
        assert len([m for m in recorded if m.arbitration_id == 0x100]) > 20
        for _ in range(2):
            for message in recorded:
                bus.send(message, timeout=1.0)
                time.sleep(0.005)
    return begun_s, ended_s


@pytest.mark.parametrize(
    ("armed", "frames"),
    [
        (True, 300),
        pytest.param(True, 1500, marks=pytest.mark.thorough),
        pytest.param(False, 1500, marks=pytest.mark.long),
    ],
)
def test_neither_forgeries_on_the_bus_nor_a_second_daemon_nor_a_replayed_session_ever_turn_a_wheel(
    tmp_path, armed, frames
):
    with running_stack(tmp_path) as stack:
        stack.operator.wait_for("READY", READY_TIMEOUT_S)
        if armed:
            assert_others_keep_out(stack)
            stack.operator.arm()
        send_forgeries(stack, frames)
        stack.operator.request("disarm")
        stack.operator.request("task", radius_m=3.0, speed_m_s=0.45)
        begun_s, ended_s = drive_and_replay(stack)
        rows = stack.truth()
    assert max(row.fastest for row in rows if begun_s < row.t_s < ended_s) > 5.0
    for undriven in ([row for row in rows if row.t_s < begun_s], [row for row in rows if row.t_s > ended_s]):
        assert max(row.requested for row in undriven) == 0.0
        assert max(row.fastest for row in undriven) < STATIONARY_RAD_S


SEEDED_ROBOT = """
import sys
from pathlib import Path
from sim.app import VirtualRobotOptions, run_virtual_robot
from sim.body_dynamics import BodyPose
sys.exit(run_virtual_robot(VirtualRobotOptions(
    channel=sys.argv[1], truth_file=Path(sys.argv[2]), bus_log=Path(sys.argv[3]), start=BodyPose(3.0, 0.0, 1.57),
    challenge_seed=5)))
"""


@contextmanager
def virtual_robot(folder, robot_file, name, seeded):
    """One life of the controller, as a process; yields where its truth and its bus are recorded."""
    truth, bus, reported = folder / f"{name}.csv", folder / f"{name}.log", folder / f"{name}.txt"
    command = ["-m", "disco_hw", "sim", str(robot_file), "--truth", str(truth), "--bus-log", str(bus)]
    if seeded:
        command = ["-c", SEEDED_ROBOT, str(folder / "bus"), str(truth), str(bus)]
    with reported.open("wb") as output, subprocess.Popen([sys.executable, *command], stdout=output) as robot:
        try:
            wait_until(lambda: "ready" in reported.read_text(), READY_TIMEOUT_S)
            yield truth, bus
        finally:
            robot.terminate()


def from_the_host(bus_log):
    """What a candump log holds of a host's frames: (time in s, identifier, data)."""
    for line in bus_log.read_text().splitlines():
        time_s, _, frame = line.split()[:3]
        can_id, data = frame.split("#")
        if int(can_id, 16) in {0x100, 0x101, 0x102}:
            yield float(time_s.strip("()")), int(can_id, 16), bytes.fromhex(data)


@pytest.mark.parametrize(
    "seeded",
    [pytest.param(False, marks=pytest.mark.thorough), pytest.param(True, marks=pytest.mark.long)],
    ids=["entropy", "a seed asked for by name"],
)
def test_a_session_recorded_before_a_restart_does_not_arm_after_it(tmp_path, seeded):
    """Without a key. The robot with a seed, whose entropy repeats, shows that the recording is a good one."""
    robot_file = write_robot_file(tmp_path)
    drive = ["drive", str(robot_file), "--script", "circle", "--unattended", "--seconds", "4"]
    with virtual_robot(tmp_path, robot_file, "first", seeded) as (truth, bus_log):
        _, reported = disco(*drive, "--log", str(tmp_path / "drive.mcap"))
    assert "script circle completed" in reported
    assert max(row.fastest for row in read_truth(truth)) > 1.0
    sent = list(from_the_host(bus_log))
    with virtual_robot(tmp_path, robot_file, "second", seeded) as (truth, _):
        with can.Bus(interface="unixcan", channel=str(tmp_path / "bus")) as bus:
            begin_s = time.monotonic()
            for at_s, can_id, data in sent:
                time.sleep(max(0.0, begin_s + at_s - sent[0][0] - time.monotonic()))
                bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False), timeout=1.0)
                while bus.recv(0.0):
                    pass
        time.sleep(0.3)
    rows = read_truth(truth)
    assert ({row.state for row in rows} >= {"ARMED"}) == seeded
    assert (max(row.fastest for row in rows) > STATIONARY_RAD_S) == seeded
    assert (max(row.requested for row in rows) > 0.0) == seeded
    assert "READY" in {row.state for row in rows}, "the recording does not even begin a session"


def test_garbage_on_a_serial_line_leaves_the_daemon_waiting(tmp_path):
    """A line on which somebody shouts: the daemon counts it, says so, ends cleanly and never reaches READY."""
    robot_file = write_robot_file(tmp_path, link="serial")
    master, slave = pty.openpty()
    tty.setraw(slave)
    Path(tmp_path / "tty").symlink_to(os.ttyname(slave))
    rng = random.Random(1)
    stop = threading.Event()

    def shout() -> None:
        while not stop.is_set():
            os.write(master, rng.randbytes(64) + struct.pack("B", 0))
            time.sleep(0.002)

    thread = threading.Thread(target=shout)
    thread.start()
    try:
        with disco_hw_process("daemon", ["run", str(robot_file)], tmp_path / "daemon.txt") as daemon:
            operator = Operator(tmp_path / "control.sock", (daemon,))
            status = operator.wait_until("counting", lambda s: s["transport"]["malformed"] > 200, READY_TIMEOUT_S)
            assert status["state"] == "HANDSHAKE"
            with pytest.raises(WorkError, match="refused to arm"):
                operator.request("arm")
            operator.request("quit")
            assert daemon.process.wait(60.0) == 0
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("verb", "csv", "message"),
    [
        ("run", "x_m,y_m\n0,0\n1,one\n", "line 3: y_m: 'one' is not a finite number; write one"),
        ("sim", "x_m,y_m\n0,0\n", "1 way-points; write at least two"),
        ("check", "x,y\n0,0\n1,1\n", "line 1: column x_m: missing; name x_m and y_m there"),
        ("view", "x_m,y_m\n0,0\n0,0\n", "line 3: repeats the way-point before it; remove it"),
        (
            "check",
            "x_m,y_m\n0,0\n1,0\n1,0.2\n0,0.2\n",
            "lines 3 to 4: the path turns twice within 0.28 m, where the robot would leave",
        ),
        ("run", None, "cannot be read"),
    ],
)
def test_a_bad_path_gets_one_line_and_exit_code_2(tmp_path, verb, csv, message):
    path = path_robot(tmp_path, csv or "")
    if csv is None:
        (tmp_path / "path.csv").unlink()
    code, output = disco_here(verb, *(["--live", "--robot"] if verb == "view" else []), str(path))
    assert code == 2, output
    assert len(output.strip().splitlines()) == 1
    assert str(tmp_path / "path.csv") in output
    assert message in output


def test_a_daemon_can_be_asked_to_stop_when_the_path_is_gone(tmp_path):
    path = path_robot(tmp_path)
    (tmp_path / "path.csv").unlink()
    code, output = disco_here("ctl", str(path), "disarm")
    assert code == 1, output
    assert "path.csv" not in output
