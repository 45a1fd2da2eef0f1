"""In simulated time, with the real plant, the real C core and the real codec on both ends of a simulated CAN bus."""

import csv
import io
import math

import pytest

from drivers.types import Frame
from firmware_protocol.firmware_core import FirmwareConfig, ResetCause
from sim.body_dynamics import BodyPose
from sim.bus import CanBus
from sim.can_protocol import CanFrame
from sim.plant import Plant
from sim.plant_parameters import PlantParameters
from sim.process import TextRecord
from sim.virtual_robot import FLUSH_NS, TRUTH_COLUMNS, ControllerClock, TruthRecorder, VirtualRobot, truth_row
from tests.sim.minimal_host import MinimalHost

CONFIG = FirmwareConfig(ticks_per_rev=2048, max_wheel_speed_rad_s=8.0)
NOISELESS = PlantParameters().noiseless()


@pytest.fixture
def robot():
    robot = VirtualRobot(Plant(start=BodyPose(1.0, -2.0, 0.5)), CONFIG)
    robot.step(1000)
    return robot


def read(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_row_has_the_columns_and_the_true_values(robot):
    (row,) = read(",".join(TRUTH_COLUMNS) + "\n" + truth_row(robot, 42))
    assert None not in row
    assert None not in row.values()
    truth = robot.plant.truth
    assert row["t_ns"] == "42"
    assert (float(row["x_m"]), float(row["y_m"]), float(row["yaw_rad"])) == pytest.approx((1.0, -2.0, 0.5), abs=1e-5)
    assert float(row["left_speed_rad_s"]) == pytest.approx(truth.left_speed_rad_s, abs=1e-4)
    assert float(row["speed_m_s"]) == pytest.approx(truth.speed_m_s, abs=1e-5)
    assert row["state"] == robot.outputs.state
    assert (row["driver_enabled"], row["brake"], row["session"]) == ("0", "1", "0")


def test_rows_are_on_disk_after_a_second_and_at_the_end(tmp_path, robot):
    path = tmp_path / "truth.csv"
    record = TextRecord(path, print)
    recorder = TruthRecorder(record)
    assert read(path.read_text()) == []
    for t_ns in range(FLUSH_NS, 3 * FLUSH_NS, FLUSH_NS // 10):
        recorder.record(robot, t_ns)
    assert len(read(path.read_text())) >= 11
    record.close()
    assert len(read(path.read_text())) == 20


class Setup:
    """Host, bus and robot; one `run` millisecond is one robot step and one look of the host."""

    def __init__(self, parameters=NOISELESS, **options):
        self.bus = CanBus()
        self.host_node = self.bus.attach("host", capacity=64)
        self.robot_node = self.bus.attach("robot", capacity=64)
        self.robot = VirtualRobot(Plant(parameters, seed=1), CONFIG, **options)
        self.host = MinimalHost()
        self.now_ms = 0
        self.frames = []

    def run(self, milliseconds, until=None):
        for _ in range(milliseconds):
            self.now_ms += 1
            for delivery in self.bus.advance(self.now_ms * 1_000_000):
                frame = Frame(delivery.frame.can_id, delivery.frame.data)
                if delivery.sender is self.robot_node:
                    self.frames.append((delivery.t_ns, frame))
                    self.host.receive(frame)
                else:
                    self.robot.receive(delivery.t_ns // 1000, frame)
            due = [(self.robot_node, frame) for frame in self.robot.step(self.now_ms * 1000)]
            due += [(self.host_node, frame) for frame in self.host.due(self.now_ms)]
            for node, frame in due:
                assert self.bus.send(node, CanFrame(frame.can_id, frame.data))
            if until is not None and until():
                return
        assert until is None, "it did not come to it"

    def arm(self):
        self.host.request = "READY"
        self.run(2000, until=lambda: self.host.robot_state == "READY")
        self.host.request = "ARM"
        self.run(2000, until=lambda: self.host.robot_state == "ARMED")

    def drive(self, left_rad_s, right_rad_s, milliseconds):
        self.arm()
        self.host.speeds = (left_rad_s, right_rad_s)
        self.run(milliseconds)

    def wheel_speed(self):
        truth = self.robot.plant.truth
        return max(abs(truth.left_speed_rad_s), abs(truth.right_speed_rad_s))


@pytest.fixture
def setup():
    return Setup()


def test_handshake_arm_drive_stop(setup):
    setup.run(50)
    assert setup.host.robot_state == "STANDBY"
    assert setup.wheel_speed() == 0.0
    setup.arm()
    assert setup.wheel_speed() < 0.01
    setup.host.speeds = (2.0, 3.0)
    setup.run(1500)
    truth = setup.robot.plant.truth
    assert truth.left_speed_rad_s == pytest.approx(2.0, abs=0.02)
    assert truth.right_speed_rad_s == pytest.approx(3.0, abs=0.02)
    assert setup.host.latest["WHEEL_SPEED"]["left_speed"] == pytest.approx(2.0, abs=0.1)
    assert truth.yaw_rad > 0.0
    ticks = setup.host.latest["WHEEL_TICKS"]
    assert ticks["left_ticks"] / ticks["right_ticks"] == pytest.approx(2 / 3, abs=0.02)
    setup.host.request = "STANDBY"
    setup.run(1000, until=lambda: setup.host.robot_state == "STANDBY")
    setup.run(300)
    assert setup.wheel_speed() < 0.01


def test_silence_stops_the_wheels_in_time(setup):
    setup.drive(4.0, 4.0, 1000)
    assert setup.wheel_speed() == pytest.approx(4.0, abs=0.05)
    setup.host.silent = True
    decelerating_s = 4.0 / CONFIG.stop_deceleration_rad_s2
    lag_s = 5.0 * PlantParameters().speed_loop_time_constant_s
    setup.run(round(1000 * (0.1 + decelerating_s + lag_s)) + 20)
    assert setup.wheel_speed() < 0.05
    setup.run(1000)
    assert (setup.robot.outputs.driver_enabled, setup.robot.outputs.brake) == (False, True)
    assert setup.robot.outputs.state != "ARMED"


def test_coasting_wheels_roll_on_and_braked_ones_stop(setup):
    setup.drive(4.0, 4.0, 1000)
    setup.host.mode, setup.host.speeds = "COAST", (0.0, 0.0)
    setup.run(200)
    assert (setup.robot.outputs.driver_enabled, setup.robot.outputs.brake) == (False, False)
    assert setup.wheel_speed() > 2.0
    setup.robot.reboot()
    assert (setup.robot.outputs.driver_enabled, setup.robot.outputs.brake) == (False, True)
    setup.run(200)
    assert setup.wheel_speed() < 0.05


def test_the_estop_button_stops_and_latches(setup):
    setup.drive(4.0, 4.0, 500)
    setup.robot.estop_button = True
    setup.run(700)
    assert setup.wheel_speed() < 0.01
    assert setup.host.robot_state == "ESTOP"
    setup.robot.estop_button = False
    setup.run(500)
    assert setup.host.robot_state == "ESTOP"
    assert setup.wheel_speed() == 0.0


def test_ticks_and_pose_show_what_the_plant_does(setup):
    setup.drive(3.0, 3.0, 2000)
    setup.host.speeds = (0.0, 0.0)
    setup.run(1000)
    truth, ticks = setup.robot.plant.truth, setup.host.latest["WHEEL_TICKS"]
    distance_m = ticks["left_ticks"] / 2048 * 2 * math.pi * setup.robot.plant.parameters.wheel_radius_m
    assert math.hypot(truth.x_m, truth.y_m) == pytest.approx(distance_m, rel=0.02)
    assert setup.host.latest["POSE_POSITION"]["x"] == pytest.approx(truth.x_m, abs=1e-3)
    assert setup.host.latest["POSE_HEADING"]["yaw"] == pytest.approx(truth.yaw_rad, abs=1e-3)


def test_poses_come_at_their_rate_and_late_with_the_device_time_of_the_sample(setup):
    setup.arm()
    setup.host.speeds = (3.0, 3.0)
    setup.frames.clear()
    setup.run(1000)
    codec = setup.host.codec
    headings = [(t_ns, frame) for t_ns, frame in setup.frames if frame.can_id == codec.can_id("POSE_HEADING")]
    assert len(headings) == pytest.approx(25, abs=1)
    for t_ns, frame in headings:
        sample_us = codec.decode(frame.can_id, frame.data).values["sample_time"]
        assert 30_000 <= (setup.robot.device_us(t_ns // 1000) - sample_us) % 6_553_600 <= 33_000


def test_the_device_clock_has_its_own_start_and_speed():
    clock = ControllerClock(start_us=5_000_000, skew_ppm=40.0)
    assert clock.at(0) == 5_000_000
    assert clock.at(1_000_000_000) == 5_000_000 + 1_000_040_000
    setup = Setup(clock=clock)
    setup.run(6_000)
    times_us = setup.host.times
    assert len(times_us) == 6
    assert times_us[0] == pytest.approx(5_000_000 + 7_000, abs=1000)
    assert (times_us[-1] - times_us[0]) / 5e6 - 1.0 == pytest.approx(40e-6, abs=20e-6)


def fault(setup):
    """The name of the fault that the robot is in."""
    return setup.host.codec.choice_name("SYSTEM_STATE", "fault", setup.robot.outputs.fault)


def test_error_counters_of_the_link_reach_the_firmware(setup):
    setup.run(100)
    setup.robot.step(setup.robot.plant.now_us + 1000, (256, 3))
    assert fault(setup) == "BUS_OFF"


def test_a_watchdog_reset_is_a_fault(setup):
    setup.run(10)
    setup.robot.reboot(ResetCause.WATCHDOG)
    setup.run(10)
    assert fault(setup) == "WATCHDOG_RESET"


def test_kidnapping_moves_the_pose_and_not_the_ticks(setup):
    setup.run(100)
    before = setup.robot.plant.encoder_ticks
    setup.robot.plant.kidnap(0.5, -0.25, 1.0)
    setup.run(200)
    assert setup.robot.plant.encoder_ticks == before
    assert setup.host.latest["POSE_POSITION"] == pytest.approx({"valid": 1, "x": 0.5, "y": -0.25}, abs=1e-3)


def test_a_restart_forgets_the_session_and_stands_still(setup):
    setup.drive(4.0, 4.0, 500)
    position = setup.robot.plant.truth.x_m
    setup.robot.reboot()
    assert setup.robot.outputs.left_setpoint_rad_s == 0.0
    setup.run(1)
    assert setup.robot.outputs.state in {"BOOT", "STANDBY"}
    assert setup.robot.device_us(setup.robot.plant.now_us) == 1000
    setup.run(1000)
    assert setup.wheel_speed() < 0.01
    assert setup.robot.plant.truth.x_m >= position
    assert setup.robot.outputs.session == 0


def challenges(**options):
    """The first one of three starts, by way of two restarts."""
    setup, seen = Setup(**options), []
    for _ in range(3):
        setup.run(20)
        seen.append(setup.robot.firmware.challenge)
        setup.robot.reboot()
    return seen


def test_every_start_and_every_restart_draws_a_challenge_of_its_own():
    seen = [challenge for _ in range(3) for challenge in challenges()]
    assert len(set(seen)) >= len(seen) - 1, "of 65535; two equal ones may happen, three hardly ever"


def test_only_a_seed_that_is_asked_for_by_name_repeats_them():
    assert challenges(challenge_seed=3) == challenges(challenge_seed=3)
    assert len(set(challenges(challenge_seed=3))) == 3


def test_two_runs_with_one_seed_are_equal():
    runs = []
    for _ in range(2):
        setup = Setup(parameters=PlantParameters(), challenge_seed=5)
        setup.drive(3.0, 2.0, 500)
        runs.append((setup.frames, setup.robot.plant.truth))
    assert runs[0] == runs[1]
