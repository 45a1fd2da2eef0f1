"""What `check` concludes from what a robot says; the verb as a whole is tested in tests/hil."""

import math
import socket
import time
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import pytest

from disco_hw.daemon import check, run
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime.assembly import create_pipeline
from disco_hw.runtime.core import TaskPilot
from disco_hw.runtime.pipeline import NoPlanner
from disco_hw.runtime.preflight import Level
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor import create_driver
from drivers.pose.robot import RobotPoses
from drivers.transport import connect_pair
from drivers.types import Frame, LinkState, OutgoingFrame, PoseSample, ReceivedFrame, WheelSample
from firmware_protocol.codec import Codec
from firmware_protocol.status_codes import FAULTS
from tests.daemon.control_daemon import ControlDaemon
from tests.drivers.motor.reference_robot import CONFIG, ReferenceRobot
from tests.robot import test_robot
from tests.runtime.simulated import ROBOT_FILE, robot_toml

KEY = bytes(range(16))
MS_NS = 1_000_000


class RobotInTime:
    """The real core on the other end of a link, which lives as fast as it is asked."""

    def __init__(self, key):
        self.link, self._far = connect_pair()
        self.link.open()
        self._far.open()
        self.robot = ReferenceRobot(replace(CONFIG, key=key))
        self._now_ns = time.monotonic_ns()
        self.stats, self.send = self.link.stats, self.link.send
        self.state, self.last_error = self.link.state, None
        self.disturb = None

    def receive(self):
        while self._now_ns < time.monotonic_ns():
            for received in self._far.receive():
                self.robot.receive(self._now_ns, received.frame)
            if self.disturb is not None:
                self.robot.receive(self._now_ns, self.disturb)
            self.robot.step(self._now_ns)
            for frame in self.robot.drain():
                self._far.send(OutgoingFrame(frame, self._now_ns), self._now_ns)
            self._now_ns += MS_NS
        return self.link.receive()


@pytest.fixture(autouse=True)
def brief(monkeypatch):
    monkeypatch.setattr(check, "_LISTEN_S", 1.2)
    monkeypatch.setattr(check, "_SETTLED_S", 0.6)


def query(robot, key=b"", poses=None):
    """Ask a robot with the host's key for all that a check needs."""
    setup = load_setup(ROBOT_FILE)
    pipeline = create_pipeline(setup.config, setup.model, NoPlanner())
    return check._query_robot(robot, create_driver(None, None, key or None), poses or RobotPoses(), pipeline)


@pytest.mark.parametrize(
    ("robot_key", "key", "disturb", "level", "text"),
    [
        (b"", b"", None, Level.OK, ""),
        (KEY, KEY, None, Level.OK, ""),
        (KEY, KEY[::-1], None, Level.FAIL, "link.key_file"),
        (b"", b"", Frame(0x101, bytes(8)), Level.WARNING, "checksum"),
    ],
    ids=["no key", "the robot's key", "another key", "frames of a stranger"],
)
def test_a_robot_must_take_what_it_is_sent(robot_key, key, disturb, level, text):
    robot = RobotInTime(robot_key)
    robot.disturb = disturb
    result = check._hearing_check(query(robot, key))
    assert result.level is level
    assert text in result.text


def test_a_fault_that_does_not_latch_fails_with_what_to_do():
    robot = RobotInTime(b"")
    robot.robot.inputs["right_temperature_c"] = 100.0
    firmware = check._firmware_check(query(robot), has_clock=True)
    assert (firmware.level, firmware.text) == (
        Level.FAIL,
        "standby: the robot reports OVER_TEMPERATURE_RIGHT: " + FAULTS["OVER_TEMPERATURE_RIGHT"].advice,
    )


class Antenna:
    """Positions without heading from a source that says of itself what it does; none while it is `silent`."""

    def __init__(self, silent):
        self.silent, self._messages = silent, ["/dev/ttyACM0: open", "fix quality 0: no fix"]

    def receive(self, now_ns, from_robot):
        return [] if self.silent else [PoseSample(now_ns, now_ns, 1.0, 2.0, math.nan, 0.02, math.nan)]

    def new_messages(self):
        messages, self._messages = self._messages, []
        return messages

    def close(self):
        pass


@pytest.mark.parametrize(
    ("silent", "expected_text"),
    [
        (False, "heading not known; the pose sensor measures none: drive one metre"),
        (True, "0 pose samples a second; fix quality 0: no fix; without a pose"),
    ],
)
def test_poses_without_heading_or_none_at_all_are_a_warning_with_the_reason(silent, expected_text):
    reported = check._telemetry_check(query(RobotInTime(b""), poses=Antenna(silent)))
    assert reported.level is Level.WARNING
    assert expected_text in reported.text


def test_wheels_that_are_turned_by_hand_show_their_side_sign_and_size():
    samples = [WheelSample(i, i, 5.0 + i, 1.0 - 0.5 * i, (0.0, 3.0, 1.0)[i], (0.0, -1.5, 0.0)[i]) for i in range(3)]
    reported = check._wheels_check(samples)
    assert (reported.level, reported.text) == (
        Level.OK,
        "left turned by +2.00 rad, at most at +3.00 rad/s; right turned by -1.00 rad, at most at -1.50 rad/s",
    )


def test_what_the_wheels_do_is_heard_while_the_check_listens():
    robot = RobotInTime(b"")
    robot.robot.pushed = 2.0
    assert check._wheels_check(query(robot).wheels).text.count("at most at +2.00 rad/s") == 2


class Mocap:
    """A motion capture at 50 Hz that is this far away, and whose poses are this old."""

    def __init__(self, x_m, age_s):
        self.x_m, self.age_ns, self._next_ns = x_m, round(1e9 * age_s), 0

    def receive(self, now_ns, from_robot):
        if now_ns < self._next_ns:
            return []
        self._next_ns = now_ns + 20 * MS_NS
        return [PoseSample(now_ns - self.age_ns, now_ns, self.x_m, 2.0, 0.1, 0.01, 0.02)]


@pytest.mark.parametrize(
    ("x_m", "age_s", "level", "expected_text"),
    [
        (1.0, 0.1, Level.OK, "none rejected"),
        (5e5, 0.1, Level.FAIL, "robot: poses at (500000, 2) m are over 1000 m from the origin; set pose.origin"),
        (1.0, 1.3, Level.FAIL, "robot: poses are 1.3 s old, over estimation.history_s = 1; raise it"),
    ],
    ids=["used", "far", "old"],
)
def test_poses_that_the_filter_refuses_fail_with_the_reason(x_m, age_s, level, expected_text):
    reported = check._telemetry_check(query(RobotInTime(b""), poses=Mocap(x_m, age_s)))
    assert reported.level is level
    assert expected_text in reported.text


def test_the_conformance_suite_keeps_out_of_a_daemons_way_too(tmp_path):
    """Two hosts would speak at once, and each test would fail for another reason."""
    robot = tmp_path / "robot.toml"
    robot.write_text(
        '[robot]\nname = "busy"\nwheel_radius_m = 0.06\naxial_distance_m = 0.31\nticks_per_rev = 2048\n'
        f'max_wheel_speed_rad_s = 8.0\n[link]\ninterface = "unixcan"\nchannel = "{tmp_path}/bus"\n'
        f'[daemon]\ncontrol_socket = "{tmp_path}/control.sock"\n'
    )
    with (
        closing(ControlDaemon(tmp_path / "control.sock", lambda _: {"ok": True})),
        pytest.raises(pytest.exit.Exception, match="a daemon is connected to this robot") as caught,
    ):
        test_robot.TestRobot.create_end(SimpleNamespace(getoption=lambda _: str(robot)))
    assert caught.value.returncode == 1


class SharedLink:
    """A link that is up, on which another host says that it is there; nothing can be sent on it."""

    name, state, last_error = "can0", LinkState.UP, None

    def __init__(self):
        self.sent = []

    def open(self):
        pass

    def close(self):
        pass

    def send(self, outgoing, now_ns):
        self.sent.append(outgoing)
        return True

    def receive(self):
        state = Codec().encode("HOST_STATE", 0, request="STANDBY", session=0, challenge_answer=0, host_fault=0)
        return (ReceivedFrame(time.monotonic_ns(), Frame(*state)),)


def test_nothing_is_sent_on_a_link_on_which_another_host_speaks(monkeypatch, tmp_path):
    """The service's daemon has its control socket where another user does not look."""
    link = SharedLink()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(check, "create_link", lambda _: link)
    monkeypatch.setattr(run, "create_link", lambda _: link)
    monkeypatch.setattr(run.processes, "enter_real_time", lambda _: ())
    refusal = "another host speaks on this link: it sends HOST_STATE; stop it first"
    with pytest.raises(WorkError, match=refusal):
        check.run_check(ROBOT_FILE)
    setup = load_setup(ROBOT_FILE)
    with pytest.raises(InputError, match=refusal):
        run.serve(setup, None, lambda topic, text: None, TaskPilot())
    assert not link.sent
    # A service that starts again and again leaves no logs of nothing.
    assert not list(tmp_path.rglob("*.mcap"))


def test_a_model_that_run_refuses_fails():
    setup = load_setup(ROBOT_FILE)
    assert check._model_check(setup).level is Level.OK
    lacking = replace(setup, model=replace(setup.model, missing_effects=("deadband",)))
    reported = check._model_check(lacking)
    assert reported.level is Level.FAIL
    assert "the model lacks deadband" in reported.text


def test_a_port_for_obstacles_that_run_could_not_open_is_refused(tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        file = robot_toml(tmp_path, f"[fence]\nobstacles_port = {holder.getsockname()[1]}\n")
        with pytest.raises(WorkError, match=r"fence\.obstacles_port: .*: Address already in use"):
            check.run_check(file)


def test_a_socket_that_cannot_be_looked_at_is_one_line():
    # As where the daemon runs as another user, in a directory that only that one may enter.
    setup = load_setup(ROBOT_FILE)
    daemon = msgspec.structs.replace(setup.config.daemon, control_socket=f"/tmp/{'x' * 300}")
    with pytest.raises(InputError, match="cannot be read"):
        check.refuse_while_daemon_runs(msgspec.structs.replace(setup.config, daemon=daemon))
