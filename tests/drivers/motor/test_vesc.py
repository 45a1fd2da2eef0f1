"""Tests of VESC's own: speeds that its loop does not hold, a host that pauses, restarts, status that is off."""

import pytest

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError
from drivers.motor import find_driver
from drivers.types import DriverState, Request
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.test_motor_drivers import EXAMPLES, robot_toml
from tests.drivers.motor.vendors import BY_LABEL

VESC = BY_LABEL["vesc"]


@pytest.fixture
def bench():
    return VESC.bench()


@pytest.fixture
def idle_bench(bench):
    bench.run_until(*IDLE_STATES)
    return bench


def test_a_task_that_needs_less_than_the_speed_loop_holds_is_refused_with_what_it_holds(tmp_path):
    slow = EXAMPLES["vesc"].replace("gear = 20.0", "gear = 1.0")
    with pytest.raises(InputError, match=r"task\.speed_m_s: 0\.2 m/s is slower .*; write at least 0\.81"):
        load_robot_config(robot_toml(tmp_path, f'driver = "vesc"\n{slow}'))


def test_way_points_with_times_have_no_one_speed_that_could_be_too_slow(tmp_path):
    file = robot_toml(tmp_path, f'driver = "vesc"\n{EXAMPLES["vesc"]}')
    text = file.read_text("utf-8").replace('kind = "circle"', 'kind = "timed_path"\npath = "line.csv"')
    file.write_text(text.replace("radius_m = 0.75\nspeed_m_s = 0.2\n", ""), "utf-8")
    assert load_robot_config(file).task.path == "line.csv"


@pytest.mark.parametrize("pause_s", [0.13, 0.5])
def test_a_host_that_paused_for_longer_than_the_timeout_is_disarmed(bench, pause_s):
    bench.drive(1.0, FORWARD)
    bench.pause_host(pause_s)
    bench.run(0.05)
    assert bench.driver.state is not DriverState.ARMED
    bench.run(1.0, FORWARD)
    assert bench.robot.speed_rad_s < 0.05


# The vendor's documentation/comm_can.md: duty, current, brake, speed, position, shares of current and of brake, hand
# brake and its share; a packet and a ping command nothing.
COMMANDS = {0: True, 1: True, 3: True, 4: True, 10: True, 11: True, 12: True, 13: True, 8: False, 17: False, 26: False}


@pytest.mark.parametrize(("number", "is_command"), COMMANDS.items())
def test_whatever_command_another_host_sends_a_motor_is_a_fault_and_nothing_else_is(bench, number, is_command):
    bench.drive(0.2, FORWARD)
    bench.inject_to_host(number << 8 | 23, bytes(4), extended=True)
    bench.run(0.05)
    assert ("another host" in bench.driver.detail) is is_command


def test_a_controller_that_restarts_while_armed_is_lost(bench):
    bench.drive(2.0, FORWARD)
    bench.robot.controller.restart()
    bench.run(0.1, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert "restarted" in bench.driver.detail


def test_status_messages_that_are_off_are_asked_for_by_name(bench):
    for side in bench.robot.controller.sides:
        side[0].status_ms[27] = 0
    bench.run(1.0)
    assert bench.driver.state is DriverState.HANDSHAKE
    assert "status messages 1 and 5" in bench.driver.detail


def test_it_does_not_arm_while_a_motor_turns(idle_bench):
    idle_bench.robot.speed = [2.0, 2.0]
    idle_bench.run(0.05)
    idle_bench.request(Request.ARM).run(0.05, FORWARD)
    assert idle_bench.driver.state in IDLE_STATES
    assert "is turning" in idle_bench.driver.detail
    assert not [frame for frame in idle_bench.robot.received if VESC.is_motion(frame)]


def test_it_brakes_for_as_long_as_a_motor_says_that_it_turns_and_lets_go_of_one_that_says_nothing(bench):
    """On a slope, a brake that is let go after a while would let the robot roll away."""
    bench.drive(1.0, FORWARD)
    step = bench.robot.step

    def pushed(now_ns):
        bench.robot.speed = [2.0, 2.0]
        step(now_ns)

    bench.robot.stuck, bench.robot.step = {0, 1}, pushed
    bench.request(Request.STANDBY).run(10.0)
    assert bench.driver.state is DriverState.STOPPING
    assert bench.robot.received[-1].can_id >> 8 == 2, "a brake current"
    bench.robot.drain = list
    bench.run(4.0)
    assert bench.robot.received[-1].can_id >> 8 != 2


def test_it_is_armed_only_after_zeros_for_a_while(idle_bench):
    idle_bench.robot.received.clear()
    idle_bench.drive(0.02)
    zeros = [frame for frame in idle_bench.robot.received if frame.can_id == 3 << 8 | 23]
    assert len(zeros) >= 10
    assert {frame.data for frame in zeros} == {bytes(4)}


def test_a_fault_is_named_within_half_a_second_and_the_questions_for_it_do_not_feed_the_timeout(idle_bench):
    idle_bench.run(2.0)
    sides = idle_bench.robot.controller.sides
    assert [vesc.fed for side in sides for vesc in side] == [0, 0]
    sides[1][0].values.fault = 6
    idle_bench.run(0.5)
    assert idle_bench.driver.state is DriverState.FAULT
    assert idle_bench.driver.detail == "controller 51: the motor is too hot; let it cool; remove the cause, then reset"


def test_the_emergency_stop_is_one_frame_to_all():
    (frame,) = find_driver("vesc").stop_frames(VESC.settings)
    assert (frame.can_id, frame.extended, frame.data.hex()) == (0x2FF, True, "00004e20")


@pytest.mark.parametrize("label", ["vesc", "vesc-uart"])
@pytest.mark.parametrize(("version", "is_driven"), [(b"\x05\x02", False), (b"\x05\x03", True)])
def test_firmware_that_is_too_old_is_named_as_what_to_change(label, version, is_driven):
    bench = BY_LABEL[label].bench()
    for side in bench.robot.controller.sides:
        side[0].firmware = version + side[0].firmware[2:]
    bench.run(0.5)
    bench.request(Request.ARM).run(2.0, FORWARD)
    assert (bench.driver.state is DriverState.ARMED) is is_driven
    assert ("firmware 5.03 or later" in bench.driver.detail) is not is_driven
