"""`pytest --robot=ROBOT.toml` where another controller than the reference answers: what its driver promises.

Tests marked `motion` turn the wheels, at 1.5 rad/s or the slowest speed that the controller holds.
"""

import time
from pathlib import Path

import pytest

from disco_hw.daemon.check import refuse_while_daemon_runs
from disco_hw.errors import InputError, WorkError
from disco_hw.runtime.assembly import create_link, driver_of
from disco_hw.runtime.robot_setup import load_setup
from drivers.motor import DEFAULT, find_driver
from drivers.types import DriverState, LinkState, Request, WheelCommand

IDLE_STATES = (DriverState.STANDBY, DriverState.READY)
PATIENT_S = 10.0
STANDSTILL_RAD_S = 0.15


class Robot:
    """A host at robot.toml's rate that does nothing but this; `speed_rad_s` is what the motion tests drive with."""

    def __init__(self, setup):
        link = setup.config.link
        self._setup = setup
        self.driver, self.command, self.samples, self.fastest = driver_of(setup.config), None, [], 0.0
        self.speed_rad_s = max(1.5, 1.3 * find_driver(link.driver).slowest_rad_s(link.settings()))
        self._period_s = 1.0 / setup.config.control.rate_hz
        self.transport, self._generation = None, 0
        self.connect()

    def connect(self):
        """Open the link (again)."""
        if self.transport is not None:
            self.transport.close()
            self.driver.link_down(time.monotonic_ns())
        self.transport, self._generation = create_link(self._setup), 0
        self.transport.open()

    def step(self):
        """One period."""
        now_ns = time.monotonic_ns()
        if self.transport.state is LinkState.UP and self.transport.generation != self._generation:
            self._generation = self.transport.generation
            self.driver.link_up(now_ns)
        readings = self.driver.receive(now_ns, self.transport.receive())
        self.samples += readings.wheels
        for sample in readings.wheels:
            self.fastest = max(self.fastest, abs(sample.left_speed_rad_s), abs(sample.right_speed_rad_s))
        for outgoing in self.driver.transmit(now_ns, self.command):
            self.transport.send(outgoing, now_ns)
        time.sleep(self._period_s)

    def run(self, seconds, left_rad_s=0.0, right_rad_s=0.0):
        """Command these speeds for a time, where the driver lets them through."""
        self.command = WheelCommand(left_rad_s, right_rad_s, 0.1)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.step()

    def wait(self, done, what):
        """Go on until something holds."""
        end = time.monotonic() + PATIENT_S
        while not done():
            assert time.monotonic() < end, (
                f"{what}: not within {PATIENT_S} s; {self.driver.state}: {self.driver.detail}"
            )
            self.step()

    def settle(self):
        """Stand by, standing, whatever was."""
        self.command = None
        self.driver.request(Request.STANDBY)
        self.wait(lambda: self.driver.state not in (DriverState.DISCONNECTED, DriverState.HANDSHAKE), "found")
        if self.driver.state in (DriverState.FAULT, DriverState.ESTOP):
            self.wait(self.is_stationary, "standing")
            self.driver.request(Request.RESET)
        self.wait(lambda: self.driver.state in IDLE_STATES and self.is_stationary(), "standing by")
        self.samples, self.fastest = self.samples[-1:], 0.0

    def is_stationary(self):
        """Whether the newest sample says so."""
        last = self.samples[-1:]
        return bool(last) and max(abs(last[0].left_speed_rad_s), abs(last[0].right_speed_rad_s)) < STANDSTILL_RAD_S

    def arm(self):
        """Arm, with zeros."""
        self.command = WheelCommand(0.0, 0.0, 0.1)
        self.driver.request(Request.ARM)
        self.wait(lambda: self.driver.state is DriverState.ARMED, "armed")

    def drive(self):
        """Arm, and come up to speed on both sides."""
        self.arm()
        self.run(1.5, self.speed_rad_s, self.speed_rad_s)
        assert self.driver.state is DriverState.ARMED, self.driver.detail

    def turned(self):
        """How far both wheels have turned since it was settled, in radians."""
        first, last = self.samples[0], self.samples[-1]
        return last.left_angle_rad - first.left_angle_rad, last.right_angle_rad - first.right_angle_rad


@pytest.fixture(scope="module")
def talk(request):
    try:
        setup = load_setup(Path(request.config.getoption("--robot")))
        if setup.config.link.driver in (None, DEFAULT):
            pytest.skip("the reference controller answers: tests/robot/test_robot.py")
        refuse_while_daemon_runs(setup.config)
        made = Robot(setup)
    except InputError as error:
        pytest.exit(str(error), returncode=2)
    except WorkError as error:
        pytest.exit(str(error), returncode=1)
    yield made
    made.settle()
    made.transport.close()


@pytest.fixture
def robot(talk):
    talk.settle()
    return talk


def test_it_is_found_and_says_what_it_is(robot):
    assert robot.driver.identity.controller
    assert robot.driver.limits.max_wheel_speed_rad_s.value > robot.speed_rad_s


def test_nothing_turns_before_it_is_armed(robot):
    robot.run(1.0, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.driver.state in IDLE_STATES
    assert robot.fastest < STANDSTILL_RAD_S


def test_a_new_link_finds_it_again_and_arms_nothing(robot):
    robot.connect()
    robot.wait(lambda: robot.driver.state in IDLE_STATES, "found again")
    robot.run(0.5, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.fastest < STANDSTILL_RAD_S


@pytest.mark.motion
def test_armed_with_zeros_it_stands(robot):
    robot.arm()
    robot.run(1.0)
    assert robot.driver.state is DriverState.ARMED, robot.driver.detail
    assert robot.fastest < STANDSTILL_RAD_S


@pytest.mark.motion
@pytest.mark.parametrize(("left", "right"), [(1, 1), (-1, -1), (1, -1), (-1, 1)])
def test_the_wheels_follow_and_count_the_way_they_turn(robot, left, right):
    robot.arm()
    robot.run(2.0, left * robot.speed_rad_s, right * robot.speed_rad_s)
    assert robot.driver.state is DriverState.ARMED, robot.driver.detail
    last = robot.samples[-1]
    commanded = (left * robot.speed_rad_s, right * robot.speed_rad_s)
    assert (last.left_speed_rad_s, last.right_speed_rad_s) == pytest.approx(commanded, rel=0.3)
    assert robot.turned() == pytest.approx([2.0 * each for each in commanded], rel=0.5)


@pytest.mark.motion
def test_disarmed_it_comes_to_stand_and_stays(robot):
    robot.drive()
    robot.driver.request(Request.STANDBY)
    robot.wait(lambda: robot.driver.state in IDLE_STATES and robot.is_stationary(), "standing")
    robot.fastest = 0.0
    robot.run(1.0, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.fastest < STANDSTILL_RAD_S


@pytest.mark.motion
def test_a_silent_host_is_stopped_by_the_controller_and_nothing_arms_again(robot):
    robot.drive()
    time.sleep(robot.driver.limits.command_timeout_s.value + 2.0)
    robot.run(0.2, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.driver.state is not DriverState.ARMED
    robot.wait(robot.is_stationary, "standing")
    robot.fastest = 0.0
    robot.run(1.0, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.fastest < STANDSTILL_RAD_S


@pytest.mark.motion
def test_an_emergency_stop_holds_until_it_is_reset(robot):
    robot.drive()
    now_ns = time.monotonic_ns()
    for outgoing in robot.driver.estop(now_ns):
        robot.transport.send(outgoing, now_ns)
    robot.wait(lambda: robot.driver.state is DriverState.ESTOP and robot.is_stationary(), "in e-stop, standing")
    robot.driver.request(Request.ARM)
    robot.fastest = 0.0
    robot.run(1.0, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.driver.state is DriverState.ESTOP
    assert robot.fastest < STANDSTILL_RAD_S
    robot.driver.request(Request.RESET)
    robot.wait(lambda: robot.driver.state in IDLE_STATES, "reset")


@pytest.mark.motion
def test_a_link_that_is_renewed_while_it_drives_stops_it_and_never_arms(robot):
    robot.drive()
    robot.connect()
    robot.wait(lambda: robot.driver.state in (*IDLE_STATES, DriverState.FAULT) and robot.is_stationary(), "standing")
    robot.fastest = 0.0
    robot.run(1.0, robot.speed_rad_s, robot.speed_rad_s)
    assert robot.driver.state is not DriverState.ARMED
    assert robot.fastest < STANDSTILL_RAD_S
