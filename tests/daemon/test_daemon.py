"""The daemon on vendors' simulated controllers and in simulated time: how it stops the wheels, and what it answers."""

import errno
from types import SimpleNamespace

import pytest

from disco_hw import processes
from disco_hw.daemon.daemon import Daemon
from disco_hw.log.recorder import NullRecorder, RecorderStats
from disco_hw.log.records import Event
from disco_hw.runtime import IN_USE, State
from disco_hw.runtime.assembly import assemble_core, create_pipeline, driver_of
from disco_hw.runtime.core import PilotTick, TaskPilot
from disco_hw.runtime.pipeline import Manual, NoPlanner
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.motor import find_driver
from drivers.transport.inprocess import connect_pair
from drivers.types import DriverState, Frame, OutgoingFrame
from sim.devices import find_controller
from tests.drivers.motor.vendor_rig import START_NS, TICKS_PER_REV, VendorRig

MS = 1_000_000
# The fastest that the example of each driver allows, with wheels of 0.06 m.
SPEEDS_RAD_S = {"agilex": 24.0, "odrive": 11.0, "roboclaw": 5.0, "ros2_base": 24.0, "vesc": 11.0}
SLOW = {"odrive": "stop_deceleration_rad_s2 = 4.0", "vesc": "stop_deceleration_rad_s2 = 4.0"}


class Recorder(NullRecorder):
    watched = False
    restored = 0

    def restore_feeds(self):
        self.restored += 1


class Hand(TaskPilot):
    """Drives on by hand."""

    def __init__(self, motion):
        self._motion = motion

    def step(self, now_ns, last):
        return PilotTick(motion=self._motion, by_hand=True)


class Driven:
    """A vendor's robot under the daemon's core; the clock of a daemon, which lets its wheels turn on."""

    def __init__(self, folder, name, lines="", coasting_s=3.0):
        driver, speed_rad_s = find_driver(name), SPEEDS_RAD_S[name]
        file = folder / "robot.toml"
        file.write_text(
            f'[robot]\nname = "r"\nwheel_radius_m = 0.06\naxial_distance_m = 0.31\nticks_per_rev = {TICKS_PER_REV}\n'
            f"max_wheel_speed_rad_s = {speed_rad_s}\n"
            f'[link]\ndriver = "{name}"\nkind = "{driver.kinds[0]}"\n{driver.example}\n{lines}\n'
        )
        setup = load_setup(file)
        config = setup.config
        self.host, self.robot = connect_pair()
        self.host.open()
        self.robot.open()
        settings = config.link.settings()
        exchange = driver.exchange(settings) if driver.kinds[0] == "serial" else None
        self.rig = VendorRig(find_controller(name)(settings, TICKS_PER_REV), exchange, coasting_s)
        pipeline = create_pipeline(config, setup.model, NoPlanner())
        self.core = assemble_core(
            config, self.host, driver_of(config), pipeline, NullRecorder(), needs_pose=False, adaptation=None
        )
        self.core.directions = None
        self._now_ns, self._suspended_ns = START_NS, 0
        self.motion = Manual(speed_rad_s, speed_rad_s)
        self.daemon = Daemon(
            self.core, SimpleNamespace(poll=list, restore=lambda: None), Recorder(), self,
            SimpleNamespace(received=None), lambda *_text: None, Hand(self.motion),
        )  # fmt: skip

    def now_ns(self):
        return self._now_ns

    def sleep_until_ns(self, deadline_ns):
        while self._now_ns < deadline_ns:
            self._now_ns += MS
            self._step_robot()
            for frame in self.rig.drain():
                sent = Frame(frame.can_id, frame.data, frame.extended)
                self.robot.send(OutgoingFrame(sent, self._now_ns + MS), self._now_ns)

    def _step_robot(self):
        now_ns = self._now_ns + self._suspended_ns
        for received in self.robot.receive():
            self.rig.receive(now_ns, received.frame)
        self.rig.step(now_ns)

    def suspend(self, duration_s):
        """The clock of this computer stands still; the robot's time goes on, and what it sends is lost."""
        for _ in range(round(1e3 * duration_s)):
            self._suspended_ns += MS
            self._step_robot()
            self.rig.drain()

    def run(self, duration_s, *requests):
        for _ in range(round(50 * duration_s)):
            tick = self.core.tick(self._now_ns, requests, motion=self.motion, by_hand=True)
            requests = ()
            self.sleep_until_ns(self._now_ns + 20 * MS)
        return tick

    def run_until(self, reached, *requests):
        tick = self.run(0.02, *requests)
        for _ in range(200):
            if reached(tick):
                break
            tick = self.run(0.02)
        return tick

    def drive(self):
        self.run_until(lambda tick: tick.output.state is State.READY)
        self.run_until(lambda tick: tick.output.state is State.ARMED, UserRequest.ARM)
        full_speed_rad_s = pytest.approx(self.motion.left_rad_s, rel=0.02)
        tick = self.run_until(lambda _tick: self.rig.speed_rad_s == full_speed_rad_s, UserRequest.START)
        assert (tick.output.state, tick.output.running) == (State.ARMED, True), tick.output.detail
        assert self.rig.speed_rad_s == full_speed_rad_s


@pytest.fixture(params=SPEEDS_RAD_S)
def name(request):
    return request.param


def test_after_a_suspend_of_this_computer_the_robot_does_not_drive_on(tmp_path, name):
    driven = Driven(tmp_path, name, coasting_s=0.2)
    driven.drive()
    driven.suspend(3.0)
    driven.daemon._suspend_watch = SimpleNamespace(suspended_s=[*(50 * [0.0]), 3.0].pop)
    said = []
    driven.daemon._report = lambda *text: said.append(text)
    fastest_rad_s = driven.rig.speed_rad_s
    for _ in range(50):
        driven.daemon._tick(driven.now_ns())
        driven.sleep_until_ns(driven.now_ns() + 20 * MS)
        fastest_rad_s = max(fastest_rad_s, driven.rig.speed_rad_s)
    assert fastest_rad_s < 0.1
    assert driven.core.state not in IN_USE
    (text,) = [text for kind, text in said if kind == "link"]
    assert "was suspended for 3 s" in text
    assert "wall-clock times in the log are that much too early" in text


def test_of_a_fence_into_which_the_task_does_not_fit_that_is_said(tmp_path):
    driven, replies = Driven(tmp_path, "agilex"), []
    driven.daemon._server = SimpleNamespace(reply=lambda _message, body: replies.append(body["text"]))
    for radius_m in (3.0, 0.8):
        fence = {"keep_in": {"center": [0.0, 0.0], "radius_m": radius_m}}
        driven.daemon._change_area(driven.now_ns(), SimpleNamespace(action="fence", arguments=fence))
    assert "the task does not fit into it" not in replies[0]
    assert "; the task does not fit into it: the task" in replies[1]


def fails(*_arguments, **_options):
    raise RuntimeError("planted")


def test_without_a_fault_they_stand_before_it_ends_however_fast_they_were(tmp_path, name):
    driven = Driven(tmp_path, name, SLOW.get(name, ""))
    driven.drive()
    driven.daemon.stop_wheels()
    assert driven.rig.speed_rad_s < 0.5
    assert driven.core.state is State.READY


def test_after_a_failure_of_the_loop_the_driver_alone_brings_them_to_a_stand(tmp_path, name):
    driven = Driven(tmp_path, name)
    driven.drive()
    driven.core.tick = fails
    driven.daemon._failed = True
    driven.daemon.stop_wheels()
    assert driven.rig.speed_rad_s < 0.5


def test_where_the_tick_fails_while_they_stop_the_driver_goes_on_and_the_failure_is_passed_on(tmp_path, name):
    driven = Driven(tmp_path, name)
    driven.drive()
    driven.core.tick = fails
    with pytest.raises(RuntimeError, match="planted"):
        driven.daemon.stop_wheels()
    assert driven.rig.speed_rad_s < 0.5


def test_where_the_driver_fails_too_the_last_frames_are_those_of_an_emergency_stop(tmp_path, name):
    driven = Driven(tmp_path, name, coasting_s=0.2)
    driven.drive()
    driven.daemon._failed = True
    driven.core.driver.transmit = fails
    with pytest.raises(RuntimeError, match="planted"):
        driven.daemon.stop_wheels()
    speed_rad_s = driven.rig.speed_rad_s
    driven.sleep_until_ns(driven.now_ns() + 1500 * MS)
    assert driven.rig.speed_rad_s < 0.05 * speed_rad_s


def test_an_emergency_stop_is_accepted_while_they_stop(tmp_path):
    driven, replies = Driven(tmp_path, "agilex"), []
    driven.drive()
    messages = [[], [SimpleNamespace(action="status"), SimpleNamespace(action="estop")]]
    driven.daemon._server = SimpleNamespace(
        poll=lambda: messages.pop() if messages else [], reply=lambda message, body: replies.append((message, body))
    )
    driven.daemon.stop_wheels()
    ((message, body),) = replies
    assert (message.action, body["ok"], driven.core.driver.state) == ("estop", True, DriverState.ESTOP)
    assert driven.rig.speed_rad_s < 0.5


def test_an_emergency_stop_goes_on_while_they_turn_where_they_brake_only_as_long_as_they_are_told_to(tmp_path):
    driven = Driven(tmp_path, "vesc", coasting_s=0.5)
    driven.drive()
    driven.rig.stuck = {0, 1}
    driven.run(0.1, UserRequest.ESTOP)
    assert driven.rig.speed_rad_s > 8.0
    driven.daemon.stop_wheels()
    assert driven.rig.speed_rad_s < 0.5


def test_a_control_socket_that_was_removed_is_looked_for_every_second_and_recorded(tmp_path):
    driven = Driven(tmp_path, "vesc")
    driven.daemon._recorder_stats = RecorderStats()
    driven.daemon._server = SimpleNamespace(restore=iter(["x.sock: was removed", None]).__next__)
    recorded = [*driven.daemon._every_second(1000 * MS), *driven.daemon._every_second(2000 * MS)]
    events = [(record.code, record.text) for record in recorded if type(record) is Event]
    assert events == [("control socket", "x.sock: was removed")]
    assert driven.daemon._recorder.restored == 1


def test_a_drive_goes_on_without_a_free_descriptor_for_the_figures_of_its_log(tmp_path, monkeypatch):
    driven = Driven(tmp_path, "vesc")
    driven.daemon._recorder_stats = RecorderStats()

    def fail():
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(processes, "stolen_ms", fail)
    (counted,) = driven.daemon._every_second(1000 * MS)
    assert counted.loop["stolen_ms"] == 0


@pytest.mark.parametrize("failed", [False, True])
def test_after_a_suspend_in_the_middle_of_a_stop_the_robot_does_not_move_again(tmp_path, name, failed, monkeypatch):
    driven = Driven(tmp_path, name, SLOW.get(name, ""), coasting_s=0.2)
    driven.drive()
    looked, speeds_rad_s, sleep_until_ns = [], [], driven.sleep_until_ns

    def suspended_s():
        looked.append(True)
        if len(looked) != 5:
            return 0.0
        driven.suspend(3.0)
        return 3.0

    def sleep(deadline_ns):
        sleep_until_ns(deadline_ns)
        if len(looked) >= 5:
            speeds_rad_s.append(driven.rig.speed_rad_s)

    monkeypatch.setattr(driven, "sleep_until_ns", sleep)
    driven.daemon._suspend_watch = SimpleNamespace(suspended_s=suspended_s)
    driven.daemon._failed = failed
    driven.daemon.stop_wheels()
    assert len(looked) >= 5
    assert max(speeds_rad_s, default=0.0) < 0.1
