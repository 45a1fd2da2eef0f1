"""The process as it is: started, driven over its link in real time, hurt, and stopped with real signals."""

import csv
import io
import itertools
import math
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import can
import pytest
import serial

from drivers.types import Frame
from firmware_protocol.codec import Codec
from firmware_protocol.firmware_core import FirmwareConfig
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from sim.app import VirtualRobotOptions, run_virtual_robot
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters
from sim.process import send_command
from sim.unixcan import UnixCanBus
from sim.virtual_robot import TRUTH_COLUMNS
from tests.drivers.waiting import wait_until
from tests.sim.minimal_host import MinimalHost

COMMAND_TIMEOUT_S = 0.5
# The firmware gives its host as long as it can be set to: a test that is held up for 0.1 s has not let go.
PATIENT = FirmwareConfig(
    ticks_per_rev=2048,
    max_wheel_speed_rad_s=8.0,
    command_timeout_s=COMMAND_TIMEOUT_S,
    drive_off_timeout_s=2.0,
    host_state_timeout_s=2.0,
)
RUN = """
import sys
from pathlib import PosixPath
from firmware_protocol.firmware_core import FirmwareConfig
from sim.app import VirtualRobotOptions, run_virtual_robot
from sim.body_dynamics import BodyPose
sys.exit(run_virtual_robot(VirtualRobotOptions({options})))
"""


def parsed(row):
    """A row of the truth with its numbers."""
    return {name: value if name == "state" else float(value) for name, value in row.items()}


class Robot:
    def __init__(self, directory, **options):
        self.directory = directory
        self.channel = directory / "bus"
        self.port = directory / "tty"
        files = {"inject": directory / "inject", "truth_file": directory / "truth.csv"}
        options = {"channel": str(self.channel)} | files | options
        given = ", ".join(f"{name}={value!r}" for name, value in options.items())
        self.process = subprocess.Popen(
            [sys.executable, "-c", RUN.format(options=given)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.ready = self.process.stdout.readline()

    def command(self, text):
        return send_command(self.directory / "inject", text)

    def state(self):
        return parsed(dict(zip(TRUTH_COLUMNS, self.command("state").split(","), strict=True)))

    def wheel_speed(self):
        state = self.state()
        return max(abs(state["left_speed_rad_s"]), abs(state["right_speed_rad_s"]))

    def recorded_ns(self):
        """When the last row of its record was so: of a long one the rest is not read."""
        with (self.directory / "truth.csv").open("rb") as file:
            file.seek(-min(1000, file.seek(0, os.SEEK_END)), os.SEEK_END)
            lines = file.read().rpartition(b"\n")[0].splitlines()
        return int(lines[-1].partition(b",")[0])

    def truth(self):
        complete_lines = (self.directory / "truth.csv").read_text().rpartition("\n")[0]
        return [parsed(row) for row in csv.DictReader(io.StringIO(complete_lines))]

    def stop(self, number=signal.SIGTERM):
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=60)
        return self.process.returncode, errors


@pytest.fixture
def start(tmp_path):
    robots = []

    def start(**options):
        directory = tmp_path / str(len(robots))
        directory.mkdir()
        robots.append(Robot(directory, **options))
        assert robots[-1].ready.startswith("ready "), robots[-1].process.communicate()
        return robots[-1]

    yield start
    for robot in robots:
        robot.process.kill()
        robot.process.communicate()


class CanPort:
    def __init__(self, robot):
        self.bus = UnixCanBus(str(robot.channel))

    def read(self):
        frames = []
        while (message := self.bus.recv(0.001)) is not None and len(frames) < 20:
            if not message.is_error_frame:
                frames.append(Frame(message.arbitration_id, bytes(message.data)))
        return frames

    def write(self, frame):
        self.bus.send(can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False), timeout=1)

    def close(self):
        self.bus.shutdown()


class SerialPort:
    def __init__(self, robot):
        self.port = serial.Serial(str(robot.port), 921_600, timeout=0.001)
        self.decoder = FrameDecoder()

    def read(self):
        return [Frame(*parts) for parts in self.decoder.feed(self.port.read(max(1, self.port.in_waiting)))]

    def write(self, frame):
        self.port.write(encode_frame(frame.can_id, frame.data))

    def close(self):
        self.port.close()


def drive(port, host, seconds, until=lambda: False):
    """Let the host run on its own millisecond clock; True as soon as `until` holds."""
    start_s, sent_ms = time.monotonic(), host.now_ms
    while True:
        for frame in port.read():
            host.receive(frame)
        now_ms = sent_ms + int((time.monotonic() - start_s) * 1000)
        while host.now_ms < now_ms:
            host.now_ms += 1
            for frame in host.due(host.now_ms):
                port.write(frame)
        if until():
            return True
        if time.monotonic() - start_s > seconds:
            return False


def arm(port, host):
    host.request = "READY"
    assert drive(port, host, 30, lambda: host.robot_state == "READY"), host.latest
    host.request = "ARM"
    assert drive(port, host, 30, lambda: host.robot_state == "ARMED"), host.latest


@pytest.fixture
def host():
    host = MinimalHost(patience=round(COMMAND_TIMEOUT_S / 0.1))
    host.now_ms = 0
    return host


def test_drive_it_over_can_and_let_go(start, host):
    robot = start(firmware=PATIENT)
    port = CanPort(robot)
    arm(port, host)
    host.speeds = (2.0, 3.0)
    # What is measured scatters about what is so.
    assert drive(port, host, 30, lambda: min(host.latest["WHEEL_SPEED"]["right_speed"], robot.wheel_speed()) > 2.9)
    # The pause is the simulator's, not the host's: what came meanwhile is let in as if it had come in time.
    robot.process.send_signal(signal.SIGSTOP)
    drive(port, host, 1.6 * COMMAND_TIMEOUT_S)
    robot.process.send_signal(signal.SIGCONT)
    drive(port, host, 0.3)
    assert robot.state()["state"] == "ARMED"
    vanish_and_see_it_stop(robot, port)


@pytest.mark.thorough
def test_drive_it_over_a_serial_line_and_let_go(start, host, tmp_path):
    robot = start(kind="serial", port=str(tmp_path / "0" / "tty"), firmware=PATIENT)
    assert robot.ready.startswith(f"ready serial {robot.port} at 921600 Bd")
    port = SerialPort(robot)
    arm(port, host)
    host.speeds = (2.0, 3.0)
    assert drive(port, host, 30, lambda: robot.wheel_speed() > 2.9)
    assert robot.command("unplug 0.2") == "ok"
    with pytest.raises(OSError, match=r"."):
        drive(port, host, 30)
    vanish_and_see_it_stop(robot, port)
    again = SerialPort(robot)
    assert drive(again, host, 30, lambda: host.robot_state == "STANDBY")
    again.close()
    assert robot.stop()[0] == 0
    assert not os.path.lexists(robot.port)


def vanish_and_see_it_stop(robot, port):
    """The host goes without a word: its descriptors are closed, as when it is killed."""
    port.close()
    # Judged by the robot's own record, whenever this test gets to look at it.
    stop_deadline_ns = time.monotonic_ns() + round(1e9 * (COMMAND_TIMEOUT_S + 3.0 / 20.0 + 0.5))
    wait_until(lambda: robot.recorded_ns() > stop_deadline_ns + 200_000_000, 30.0)
    after = [row for row in robot.truth() if row["t_ns"] > stop_deadline_ns]
    assert max(abs(row[side]) for row in after for side in ("left_speed_rad_s", "right_speed_rad_s")) < 0.05
    assert "ARMED" not in {row["state"] for row in after}
    assert robot.wheel_speed() < 0.05
    assert robot.state()["state"] != "ARMED"


def end_it_cleanly(robot, number):
    for name in ("bus", "inject"):
        assert stat.S_IMODE((robot.directory / name).stat().st_mode) == 0o600
    with UnixCanBus(str(robot.channel)) as bus:
        assert bus.recv(30) is not None
        code, errors = robot.stop(number)
        assert code == 0
        assert errors.startswith("stopped after ")
        assert "Traceback" not in errors
        assert isinstance(read_to_the_end(bus), can.CanOperationError)
    assert sorted(path.name for path in robot.directory.iterdir()) == ["truth.csv"]


@pytest.mark.thorough
def test_an_interrupt_ends_it_cleanly(start):
    end_it_cleanly(start(), signal.SIGINT)


def read_to_the_end(bus):
    try:
        while bus.recv(30):
            pass
    except can.CanError as error:
        return error
    return None


@pytest.mark.thorough
def test_the_record_has_no_gap_whatever_happens_to_the_process(start, tmp_path):
    before_ns = time.monotonic_ns()
    robot = start(start=BodyPose(1.0, -2.0, 0.5), bus_log=tmp_path / "bus.log")
    wait_until(lambda: len(robot.truth()) >= 90, 30.0)
    robot.process.send_signal(signal.SIGSTOP)
    time.sleep(0.5)
    robot.process.send_signal(signal.SIGCONT)
    resumed_ns = time.monotonic_ns()
    wait_until(lambda: robot.recorded_ns() > resumed_ns, 30.0)
    robot.stop()
    rows = robot.truth()
    times = [row["t_ns"] for row in rows]
    assert {int(after - before) for before, after in itertools.pairwise(times)} == {10_000_000}
    assert before_ns < times[0] < times[-1] < time.monotonic_ns()
    assert (rows[0]["x_m"], rows[0]["y_m"], rows[0]["yaw_rad"]) == pytest.approx((1.0, -2.0, 0.5), abs=1e-4)
    messages = list(can.LogReader(tmp_path / "bus.log"))
    assert len(messages) > 300
    assert {message.channel for message in messages} == {"can0"}


def test_faults_at_run_time_and_a_clean_end_by_a_signal(start):
    robot = start()
    with UnixCanBus(str(robot.channel)) as bus:
        assert bus.recv(30) is not None, "nothing comes before the bus knows of us"
        assert robot.command("bus_off") == "ok"
        assert any(message.is_error_frame for message in iter(lambda: bus.recv(30), None))
        assert robot.command("unplug 1.5") == "ok"
        assert isinstance(read_to_the_end(bus), can.CanOperationError)
        with pytest.raises(can.CanInitializationError):
            UnixCanBus(str(robot.channel))
    wait_until(robot.channel.exists, 30.0)
    assert robot.command("bus_off robot") == "ok"
    bus_off = Codec().choice_value("SYSTEM_STATE", "fault", "BUS_OFF")
    wait_until(lambda: robot.state()["fault"] == bus_off, 30.0)
    assert robot.command("kidnap 0.5 0 0") == "ok"
    assert robot.state()["x_m"] == pytest.approx(0.5, abs=0.01)
    assert robot.command("estop_button on") == "ok"
    wait_until(lambda: robot.state()["state"] == "ESTOP", 30.0)
    assert robot.command("nonsense").startswith("error: 'nonsense' is not a command")
    assert robot.command("babble 0x100 200") == "ok"
    with UnixCanBus(str(robot.channel), can_filters=[{"can_id": 0x100, "can_mask": 0x7FF}]) as bus:
        assert [bus.recv(30).arbitration_id for _ in range(20)] == [0x100] * 20
    end_it_cleanly(robot, signal.SIGTERM)


@pytest.fixture
def signals():
    """The process takes over the signals; here that is the test's own."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    yield
    signal.set_wakeup_fd(-1)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"effects": {"moonlight": 1.0}}, "moonlight"),
        ({"channel": "/nonexistent/bus"}, "/nonexistent/bus: cannot listen here"),
        ({"kind": "serial", "port": "/nonexistent/tty"}, "/nonexistent/tty: cannot be made"),
        ({"interface": "socketcan", "channel": "nocan0"}, "socketcan nocan0: cannot be opened"),
        ({"interface": "moon"}, "cannot be opened (CAN interface 'moon' not supported)"),
        ({"truth_file": Path("/nonexistent/truth.csv")}, "/nonexistent/truth.csv: No such file or directory"),
        ({"bus_log": Path("/nonexistent/bus.log")}, "/nonexistent/bus.log: No such file or directory"),
        ({"inject": Path("/nonexistent/inject")}, "/nonexistent/inject: cannot listen here"),
        ({"bitrate": 0}, "bitrate 0: not positive"),
        ({"baud": 0, "kind": "serial"}, "baud 0: not positive"),
        ({"firmware": FirmwareConfig(2048, math.nan)}, "max_wheel_speed_rad_s=nan: out of the firmware's range"),
        ({"plant": PlantParameters(ticks_per_rev=100000)}, "ticks_per_rev=100000"),
    ],
)
def test_a_bad_option_is_one_clear_line_and_exit_code_2(tmp_path, capsys, options, line):
    code = run_virtual_robot(VirtualRobotOptions(**{"channel": str(tmp_path / "bus"), **options}))
    output, errors = capsys.readouterr()
    assert code == 2
    assert line in errors
    assert errors.count("\n") == 1
    assert output == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.thorough
def test_a_full_disk_ends_the_records_not_the_robot(start):
    robot = start(truth_file=Path("/dev/full"), bus_log=Path("/dev/full"))
    time.sleep(1.3)
    assert robot.state()["state"] == "STANDBY"
    code, errors = robot.stop()
    assert code == 1
    reported = "/dev/full: No space left on device; nothing more is recorded in it"
    assert errors.count(reported) == 2
    assert "Traceback" not in errors
