"""Tests of AgileX's own: remote control comes first, speeds of the body, a time-out of half a second, buttons."""

import dataclasses

import pytest

from disco_hw.config import load_robot_config
from disco_hw.estimation.odometry import OdometryParameters
from disco_hw.runtime.pipeline import Governor, WheelLimits
from disco_hw.runtime.wheel_faults import WheelFaults
from drivers.types import DriverState, Request
from sim.devices.agilex import CAN_MODE, STANDBY
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.test_motor_drivers import robot_toml
from tests.drivers.motor.vendors import BY_LABEL

AGILEX = BY_LABEL["agilex"]
SCOUT_TOML = "wheel_radius_m = 0.165\ntrack_m = 0.58\nmax_speed_m_s = 1.5\nmax_turn_rad_s = 0.5235\n"
SCOUT = dataclasses.replace(AGILEX, changes=SCOUT_TOML)


@pytest.fixture
def bench():
    return AGILEX.bench()


def test_a_person_who_takes_the_remote_control_drives_and_after_that_it_does_not_drive_on(bench):
    base = bench.robot.controller.base
    bench.drive(0.5, FORWARD)
    base.use_remote_control(0.3, 0.0)
    bench.run(0.3, FORWARD)
    assert bench.driver.state in IDLE_STATES, "no fault"
    assert "remote control" in bench.driver.detail
    assert bench.robot.speed == pytest.approx((5.0, 5.0))
    bench.request(Request.ARM).run(1.0)
    assert bench.driver.state in IDLE_STATES
    assert bench.robot.speed == pytest.approx((5.0, 5.0)), "the person still drives"
    base.control_mode = CAN_MODE
    bench.run(1.0, FORWARD)
    assert bench.robot.speed_rad_s == 0.0
    assert base.control_mode == STANDBY


def test_a_base_that_sends_its_state_every_200_ms_may_lose_two_of_them_and_is_missed_by_its_motion(bench):
    bench.robot.controller.base.state_ms = 200
    bench.drive(0.5, FORWARD)
    drain, lost = bench.robot.drain, {0x211}
    bench.robot.drain = lambda: [frame for frame in drain() if frame.can_id not in lost]
    bench.run(0.4)
    lost.clear()
    bench.run(0.5, FORWARD)
    assert bench.driver.state is DriverState.ARMED
    lost.add(0x221)
    bench.run(0.15, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert "the base's motion stopped reporting" in bench.driver.detail


def test_the_buttons_stop_it_and_need_a_reset(bench):
    bench.drive(0.5, FORWARD)
    bench.robot.press_estop(True)
    bench.run(0.3, FORWARD)
    assert bench.driver.state is DriverState.ESTOP
    assert bench.robot.speed_rad_s == 0.0
    bench.robot.press_estop(False)
    bench.run(1.0, FORWARD)
    assert bench.driver.state is DriverState.FAULT, "releasing the button alone is not enough"
    assert bench.robot.speed_rad_s == 0.0
    bench.request(Request.RESET).run_until(*IDLE_STATES)


@pytest.mark.parametrize("warning", [0x0002, 0x0004, 0x0200, 0x0400])
def test_a_warning_of_the_battery_or_the_remote_control_stops_nothing(bench, warning):
    bench.arm()
    bench.robot.controller.base.error_code = warning
    bench.run(0.5, FORWARD)
    assert bench.driver.state is DriverState.ARMED


@pytest.mark.parametrize("error", [0x0001, 0x0008, 0x0100])
def test_an_error_in_either_byte_stops_it(bench, error):
    bench.drive(0.5, FORWARD)
    bench.robot.controller.base.error_code = error
    bench.run(0.3, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert f"{error:#06x}" in bench.driver.detail
    assert bench.robot.speed_rad_s == 0.0


def test_turning_on_the_spot_is_a_turn_rate_by_the_nominal_track(bench):
    bench.drive(0.5, (-2.0, 2.0))
    linear, angular = bench.robot.controller.base.commanded_motion
    assert (linear, angular) == (0, round(1e3 * 0.06 * 4.0 / 0.31))
    assert bench.robot.speed == pytest.approx((-2.0, 2.0), abs=0.02)


def test_more_than_the_base_can_do_is_scaled_and_keeps_its_curve(bench):
    bench.drive(0.3, (50.0, 25.0))
    left, right = bench.robot.speed
    assert 0.06 * left == pytest.approx(1.5, abs=0.01)
    assert left / right == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize(("left", "right"), [(-4.0, 4.0), (1.0, 5.0), (-6.0, 2.0)])
def test_a_turn_faster_than_the_base_can_make_is_scaled_and_keeps_its_curve(left, right):
    bench = SCOUT.bench().drive(1.0, (left, right))
    turned = [0.165 * speed for speed in bench.robot.speed]
    assert turned[1] - turned[0] == pytest.approx(0.58 * 0.5235, abs=0.005)
    assert turned[0] / turned[1] == pytest.approx(left / right, abs=0.02)


def test_wheels_that_turn_as_fast_as_the_base_can_are_no_wheel_fault(tmp_path):
    """The governor knows the limit of the base, so that what is recorded and expected is what the wheels do."""
    config = load_robot_config(robot_toml(tmp_path, f'driver = "agilex"\n{SCOUT_TOML}'))
    limits = WheelLimits(8.0, 20.0, 20.0, max_difference_rad_s=config.largest_wheel_difference_rad_s)
    governor, faults, bench = Governor(limits, 0.02), WheelFaults(takes_body_speeds=True), SCOUT.bench()
    bench.arm()
    geometry, found, seen = OdometryParameters(0.165, 0.58, 0.0), None, 0
    for _ in range(150):
        governed = governor.step(-4.0, 4.0, 0.02)
        bench.run(0.02, (governed.left_rad_s, governed.right_rad_s))
        samples = [sample for readings in bench.readings[seen:] for sample in readings.wheels]
        seen = len(bench.readings)
        found = found or faults.step(bench.now_ns, samples, (), geometry)
        faults.commanded(bench.now_ns, bench.command)
    assert found is None
    assert bench.robot.speed == pytest.approx((governed.left_rad_s, governed.right_rad_s), abs=0.01)
    assert governed.right_rad_s == pytest.approx(0.5 * 0.5235 * 0.58 / 0.165)


@pytest.mark.parametrize("pause_s", [0.55, 2.0])
def test_a_host_that_paused_for_longer_than_the_time_out_is_disarmed(bench, pause_s):
    bench.drive(0.5, FORWARD)
    bench.pause_host(pause_s)
    bench.run(0.3, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert bench.robot.speed_rad_s == 0.0


def test_it_does_not_arm_while_the_base_moves(bench):
    bench.run_until(*IDLE_STATES)
    bench.robot.stuck, bench.robot.speed = {0, 1}, [4.0, 4.0]
    bench.run(0.1)
    bench.request(Request.ARM).run(0.3, FORWARD)
    assert bench.driver.state in IDLE_STATES
    assert "moving" in bench.driver.detail
    assert not [frame for frame in bench.robot.received if AGILEX.is_motion(frame)]


def test_a_button_pressed_while_it_slows_down_ends_that_and_its_release_moves_nothing(bench):
    bench.drive(0.5, (20.0, 20.0))
    bench.request(Request.STANDBY).run(0.1)
    bench.robot.press_estop(True)
    bench.run(0.3)
    bench.robot.press_estop(False)
    assert bench.largest_speed_in(2.0) < 0.05
    assert bench.driver.state is DriverState.FAULT


def test_a_person_who_takes_the_remote_control_while_it_slows_down_ends_that(bench):
    bench.drive(0.5, (20.0, 20.0))
    bench.request(Request.STANDBY).run(0.1)
    bench.robot.controller.base.use_remote_control(0.0, 0.0)
    bench.run(0.2)
    bench.robot.received.clear()
    bench.robot.controller.base.control_mode = CAN_MODE
    bench.run(0.5)
    assert not [frame for frame in bench.robot.received if AGILEX.is_motion(frame)]
    assert bench.driver.state in IDLE_STATES


def test_it_waits_for_the_wheels_to_stand_from_the_end_of_a_ramp_however_long_that_was():
    bench = dataclasses.replace(AGILEX, changes="stop_deceleration_rad_s2 = 1.0").bench().drive(0.5, (4.0, 4.0))
    bench.request(Request.STANDBY).run(3.8)
    bench.robot.stuck, bench.robot.speed = {0, 1}, [4.0, 4.0]
    bench.run(1.0)
    assert bench.robot.controller.base.control_mode == CAN_MODE, "standing by, it would brake no longer"
    bench.run(3.0)
    assert bench.robot.controller.base.control_mode == STANDBY
