"""A virtual robot around a board: the core, its main loop and the plant's line as a process behind terminals."""

import os
import signal
import struct
import subprocess
import sys
import threading
import time
import tty

import pytest

from drivers.transport import serial
from drivers.types import Frame
from firmware_protocol.serial_framing import encode_frame
from sim import app
from sim.board import ABOUT, HEADING, POSITION, SETPOINTS, STATE, WHEELS, BoardRobot
from sim.fault_schedule import schedule_of
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from tests.firmware_protocol.other_end import LinkEnd
from tests.firmware_protocol.ports.posix_board import build_board, prefer, running_board
from tests.firmware_protocol.protocol_host import ProtocolHost
from tools.stack import write_robot_file


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_board(tmp_path_factory.mktemp("board"), "-DDISCO_PLANT_LINE")


class SimProcess:
    """`disco-hw sim --board`, from its ready line on."""

    def __init__(self, folder, port):
        robot_file = write_robot_file(folder, "serial")
        command = [sys.executable, "-m", "disco_hw", "sim", str(robot_file), "--board", port]
        self.truth = folder / "truth.csv"
        self.process = subprocess.Popen([*command, "--truth", str(self.truth)], stdout=subprocess.PIPE, text=True)
        prefer(self.process)
        assert self.process.stdout.readline().startswith(f"ready the board on plant's line {port}")

    def row(self):
        """The last whole line of the truth, by column."""
        names, *rows = self.truth.read_text("utf-8").rsplit("\n", 1)[0].split("\n")
        return dict(zip(names.split(","), rows[-1].split(","), strict=True)) if rows else None

    def end(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        code = self.process.wait(60)
        self.process.stdout.close()
        return code


@pytest.mark.thorough
@pytest.mark.hil
def test_a_board_drives_a_virtual_robot_and_stops_when_it_goes(tmp_path, program):
    with running_board(program) as board:
        sim = SimProcess(tmp_path, board.plant)
        transport = serial.create_transport(port=board.link)
        transport.open()
        host = ProtocolHost(LinkEnd(transport), first_session=3, valid_for_s=0.5)
        try:
            host.settle()
            assert host.latest["BUILD"]["board_id"] == 0x8007
            before = host.latest["WHEEL_TICKS"]["left_ticks"]
            host.to_driving()
            # What the plant's wheels did is what the board counts, and what its pose sensor saw is what it sends.
            host.wait_for("a pose", lambda: host.latest.get("POSE_POSITION", {}).get("valid") == 1)
            host.wait_for("turning wheels", lambda: host.latest["WHEEL_TICKS"]["left_ticks"] - before > 500, 20.0)
            assert host.latest["POWER"]["voltage"] == pytest.approx(25.0, abs=0.5)
            sim.process.kill()
            host.wait_for_state("STANDBY", within_s=5.0)
            host.request = host.command = None
            sim.end()
            assert host.stop_cause == "FAULT"
            host.wait_for("the fault", lambda: host.fault == "UNDER_VOLTAGE", 5.0)
            assert host.fastest == 0.0

            # Another one begins with other counts: no jump, and the fault passes by itself.
            sim = SimProcess(tmp_path, board.plant)
            host.wait_for("no fault", lambda: host.fault == "NONE", 5.0)
            host.settle()
            host.to_driving()
            deadline = time.monotonic() + 20.0
            while (row := sim.row()) is None or float(row["left_speed_rad_s"]) < 1.0:
                assert time.monotonic() < deadline
                host.run(0.1)
            assert (row["state"], row["driver_enabled"], row["fault"]) == ("ARMED", "1", "0")
            assert int(row["accepted_commands"]) > 0
        finally:
            host.end.close()
            assert sim.end() in (0, -signal.SIGKILL)


def robot_at_rest():
    return BoardRobot(Plant(PlantParameters().noiseless()))


def telemetry_frames(left, right, *, flags=1, state=3):
    return [Frame(SETPOINTS, struct.pack("<ff", left, right)), Frame(STATE, struct.pack("<BBHI", flags, state, 0, 9))]


def test_the_wheels_turn_as_the_board_says_until_it_falls_silent():
    robot, reported = robot_at_rest(), []
    for step in range(1, 1001):
        if step <= 500:
            for frame in telemetry_frames(2.0, 3.0):
                robot.receive(step * 1000, frame)
        reported += [frame.can_id for frame in robot.step(step * 1000)]
        if step == 500:
            assert robot.outputs.state == "ARMED"
            assert robot.outputs.accepted_commands == 9
            assert robot.plant.truth.right_speed_rad_s == pytest.approx(3.0, rel=0.05)
    assert reported.count(WHEELS) == 500
    assert robot.silent
    assert not robot.outputs.driver_enabled
    assert robot.outputs.brake
    assert robot.plant.truth.right_speed_rad_s == 0.0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_setpoints_that_are_no_numbers_turn_nothing(value):
    robot = robot_at_rest()
    for frame in telemetry_frames(value, 1.0):
        robot.receive(0, frame)
    robot.step(1000)
    assert robot.outputs.left_setpoint_rad_s == robot.outputs.right_setpoint_rad_s == 0.0


def test_a_pose_is_reported_with_its_age_and_never_better_than_it_is():
    robot = robot_at_rest()
    reported = [frame for step in range(1, 101) for frame in robot.step(step * 1000)]
    heading = next(frame for frame in reported if frame.can_id == HEADING)
    _, age, position_mm, yaw_mrad = struct.unpack("<fHBB", heading.data)
    assert age == pytest.approx(300, abs=11)
    assert (position_mm, yaw_mrad) == (5, 9) or position_mm == yaw_mrad == 0
    assert sum(frame.can_id == POSITION for frame in reported) == sum(frame.can_id == HEADING for frame in reported)


class NeverStopped:
    requested = False

    def fileno(self):
        raise AssertionError("it should not have begun")


@pytest.fixture
def line(monkeypatch):
    """A line whose other end repeats a frame: `start_sending(can_id, data)` begins it and returns the port name."""
    monkeypatch.setattr(app, "StopSignal", NeverStopped)
    board, computer = os.openpty()
    tty.setraw(computer)
    ended = threading.Event()

    def write_repeatedly(data):
        while not ended.wait(0.01):
            os.write(board, data)

    threads = []

    def start_sending(can_id, data):
        threads.append(threading.Thread(target=write_repeatedly, args=[encode_frame(can_id, data)]))
        threads[-1].start()
        return os.ttyname(computer)

    yield start_sending
    ended.set()
    for thread in threads:
        thread.join()
    os.close(board)
    os.close(computer)


def refused(capsys, **options):
    assert app.run_virtual_robot(app.VirtualRobotOptions(realtime_priority=0, **options)) == 2
    return capsys.readouterr().err


def test_a_line_on_which_no_virtual_robot_is_awaited_is_refused(line, capsys, monkeypatch):
    monkeypatch.setattr(app, "BOARD_S", 0.3)
    port = line(0x130, bytes(8))
    reported = refused(capsys, board=port)
    assert f"--board {port}: no answer on the plant's line" in reported
    assert "-DDISCO_PLANT_LINE" in reported


@pytest.mark.parametrize(
    ("about", "expected_error"), [(b"\x01\x00\x00\x04", "1024 ticks"), (b"\x02\x00\x00\x08", "version 2")]
)
def test_a_board_that_does_not_fit_is_refused(line, capsys, about, expected_error):
    assert expected_error in refused(capsys, board=line(ABOUT, about + bytes(4)))


def test_a_port_that_is_not_there_is_refused(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(app, "StopSignal", NeverStopped)
    assert "cannot be opened" in refused(capsys, board=str(tmp_path / "none"))


@pytest.mark.parametrize(("kind", "lasts"), [("reboot", {}), ("clock_jump", {}), ("unplug", {"for_s": 1.0})])
def test_faults_of_what_is_the_boards_own_are_refused(line, capsys, kind, lasts):
    faults = schedule_of({"fault": [{"kind": kind, "at_s": 1.0, **lasts}]}, "faults.toml")
    assert f"{kind}: cannot be used with --board" in refused(capsys, board=line(ABOUT, bytes(8)), faults=faults)
