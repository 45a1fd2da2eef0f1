"""Tests of RoboClaw's own: its serial timeout, set and read back, stops before questions, boards that restart."""

import dataclasses

import pytest

from disco_hw.config import Control, Link
from disco_hw.runtime.preflight import Level, check_link_load
from drivers.motor import find_driver
from drivers.motor import roboclaw_protocol as protocol
from drivers.motor.roboclaw import Board
from drivers.motor.roboclaw_protocol import SETTERS
from drivers.types import DriverState, Request, WheelCommand
from sim.devices.roboclaw import Roboclaw
from tests.drivers.motor.bench import FORWARD, IDLE_STATES
from tests.drivers.motor.vendors import BY_LABEL

ONE, TWO = BY_LABEL["roboclaw"], BY_LABEL["roboclaw-a-board-a-side"]
STOP = SETTERS["duty_m1m2"].command


@pytest.fixture(params=[ONE, pytest.param(TWO, marks=pytest.mark.thorough)], ids=str)
def bench(request):
    return request.param.bench()


def boards(bench):
    return list(bench.robot.controller.boards.values())


def drive(bench):
    bench.drive(0.5, FORWARD)
    assert bench.robot.speed == pytest.approx(FORWARD, abs=0.02)


def test_the_serial_timeout_is_set_and_read_back_before_the_first_speed(bench):
    assert [board.registers.timeout_ds for board in boards(bench)] == [0] * len(boards(bench))
    bench.arm()
    for board in boards(bench):
        assert board.registers.timeout_ds == 2
        commands = [command for command, _ in board.obeyed]
        assert commands.index(14) < commands.index(40)


def test_a_board_that_does_not_keep_its_timeout_is_not_armed(bench):
    bench.run_until(*IDLE_STATES)
    receive = bench.robot.receive
    bench.robot.receive = lambda now_ns, frame: None if frame.can_id & 0xFF == 14 else receive(now_ns, frame)
    bench.request(Request.ARM).run(2.5, FORWARD)
    assert bench.driver.state in IDLE_STATES
    assert "serial timeout" in bench.driver.detail
    assert bench.largest_speed == 0.0


def test_the_first_thing_a_board_hears_is_a_stop(bench):
    """One that still holds a speed, of a daemon that was killed, must not be fed by questions."""
    bench.run(0.5)
    for address in bench.robot.controller.boards:
        assert next(frame for frame in bench.robot.received if frame.can_id >> 8 == address).can_id & 0xFF == STOP


def test_a_speed_that_was_still_waiting_behind_the_stop_is_stopped_too(bench):
    drive(bench)
    waiting = bench.driver.transmit(bench.now_ns, WheelCommand(*FORWARD, 0.1))
    bench.send_estop()
    bench.run(0.001)
    # The line was busy: what was queued before leaves behind the stop.
    for outgoing in waiting:
        bench.robot.receive(bench.now_ns, outgoing.frame)
    assert {board.command[0] for board in boards(bench)} == {"speed"}
    bench.run(0.3)
    assert bench.robot.controller.wheels_rad_s == (0.0, 0.0)
    assert bench.driver.state is DriverState.ESTOP


def test_a_board_that_restarted_standing_is_known_by_its_timeout(bench):
    bench.drive(0.3)
    bench.robot.controller.restart()
    bench.run(0.7)
    assert bench.driver.state is DriverState.FAULT
    assert "restarted" in bench.driver.detail


def test_a_board_that_takes_no_commands_is_lost_though_it_answers(bench):
    drive(bench)
    receive = bench.robot.receive
    bench.robot.receive = lambda now_ns, frame: None if frame.can_id & 0xFF == 40 else receive(now_ns, frame)
    bench.run(0.3, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert "does not accept its commands" in bench.driver.detail
    assert bench.robot.controller.wheels_rad_s == (0.0, 0.0)


@pytest.mark.parametrize("has_duty_decel", [False, True])
def test_a_board_that_ramps_zero_duty_slowly_is_refused_with_what_to_set(bench, has_duty_decel):
    """An e-stop would take seconds: command 34 is ramped by the default duty acceleration."""
    for board in boards(bench):
        board.registers.has_duty_decel = has_duty_decel
    boards(bench)[-1].registers.duty_accel_m2 = 8192
    bench.request(Request.ARM).run(1.0, FORWARD)
    assert bench.driver.state is DriverState.REFUSED
    assert f"board {boards(bench)[-1].address}: its e-stop takes 4 s from full duty" in bench.driver.detail
    assert "set Default Accel to 655359 (Motion Studio)" in bench.driver.detail
    assert bench.largest_speed == 0.0


@pytest.mark.parametrize("has_duty_decel", [False, True])
def test_an_e_stop_of_a_board_that_is_not_refused_is_over_in_a_tenth_of_a_second(bench, has_duty_decel):
    for board in boards(bench):
        board.registers.has_duty_decel = has_duty_decel
        board.registers.duty_accel_m1 = board.registers.duty_accel_m2 = 327_680
        board.registers.pid_m1 = board.registers.pid_m2 = (65536, 32768, 0, 20_000)
    bench.drive(1.0, (15.0, 15.0))
    assert bench.robot.speed == pytest.approx((15.0, 15.0), abs=0.1)
    bench.send_estop()
    bench.run(0.11)
    assert bench.robot.speed_rad_s == 0.0


def test_a_board_that_does_not_know_the_question_for_its_duty_ramp_is_driven():
    bench = ONE.bench()
    receive = bench.robot.receive
    bench.robot.receive = lambda now_ns, frame: None if frame.can_id & 0xFF == 81 else receive(now_ns, frame)
    drive(bench)


COARSE = dataclasses.replace(ONE, changes="counts_per_rev = 1000.0\n")


@pytest.mark.parametrize("speed_rad_s", [0.3, 1.5])
def test_wheels_that_roll_slowly_are_not_taken_to_stand(speed_rad_s):
    """A board's own speed is what it counted in 1/300 s: below 300 counts/s it is zero for most of the time."""
    bench = COARSE.bench(coasting_s=1e9)
    bench.run_until(*IDLE_STATES)
    bench.robot.stuck, bench.robot.speed = {0, 1}, [speed_rad_s, speed_rad_s]
    bench.run(0.5)
    speeds = [sample.left_speed_rad_s for sample in bench.wheels[-10:]]
    assert speeds == pytest.approx(10 * [speed_rad_s], abs=0.17), "one count in two periods"
    bench.request(Request.ARM).run(0.5)
    assert bench.driver.state is DriverState.STOPPING
    assert any("a motor is turning" in event for event in (*bench.events, bench.driver.detail))
    bench.send_estop()
    for _ in range(500):
        bench.step()
        assert not bench.driver._port.is_stopped
    bench.robot.speed = [0.0, 0.0]
    bench.run(0.3)
    assert bench.driver._port.is_stopped


def test_a_motor_that_stands_on_the_edge_of_a_count_stands():
    bench = COARSE.bench()
    bench.run_until(*IDLE_STATES)
    step = bench.robot.step

    def trembling(now_ns):
        bench.robot.angle[0] = 0.6 * bench.robot.angle_of_a_count * (now_ns // 7_000_000 % 2)
        step(now_ns)

    bench.robot.angle_of_a_count, bench.robot.step = 1.0 / COARSE.settings.counts_per_rad, trembling
    bench.run(0.3)
    bench.arm()


def test_answers_that_are_lost_do_not_change_the_speed():
    bench = ONE.bench(loses=lambda generator: generator.random() < 0.05)
    bench.arm()
    bench.run(1.5, FORWARD)
    assert bench.driver.state is DriverState.ARMED
    assert [sample.left_speed_rad_s for sample in bench.wheels[-30:]] == pytest.approx(30 * [FORWARD[0]], abs=0.1)


def test_its_e_stop_input_stops_it_and_needs_a_reset(bench):
    for board in boards(bench):
        board.registers.estop_lock = 0x55
    drive(bench)
    bench.robot.press_estop(True)
    bench.run(0.3, FORWARD)
    assert bench.driver.state is DriverState.ESTOP
    assert "input" in bench.driver.detail
    bench.robot.press_estop(False)
    bench.run(2.0, FORWARD)
    assert bench.driver.state is DriverState.FAULT
    assert bench.robot.speed_rad_s < 0.05
    bench.request(Request.RESET).run_until(*IDLE_STATES)


def test_an_e_stop_that_a_board_as_delivered_has_latched_ends_when_it_is_switched_off_and_on(bench):
    drive(bench)
    bench.robot.press_estop(True)
    bench.run(0.3)
    bench.robot.press_estop(False)
    bench.request(Request.RESET).run(1.0)
    assert bench.driver.state is DriverState.ESTOP
    assert bench.driver.detail == (
        "its e-stop input is or was pressed; if reset does not help, switch the board off and on"
    )
    bench.robot.controller.restart()
    bench.request(Request.RESET).run_until(*IDLE_STATES)


def test_an_e_stop_that_the_board_latches_by_itself_is_reset_only_when_asked_to(bench):
    for board in boards(bench):
        board.registers.estop_lock = 0xAA
    drive(bench)
    bench.robot.press_estop(True)
    bench.run(0.3)
    bench.robot.press_estop(False)
    bench.run(1.0)
    assert bench.driver.state is DriverState.ESTOP
    assert not [frame for frame in bench.robot.received if frame.can_id & 0xFF == 200]
    bench.request(Request.RESET).run_until(*IDLE_STATES)


@pytest.mark.parametrize(
    ("line", "motors"),
    [
        ([Roboclaw(0x83, is_on_usb=True)], ["128/1", "128/2"]),
        ([Roboclaw(0x83)], ["131/1", "131/2"]),
        ([Roboclaw(0x80), Roboclaw(0x81)], [["128/1", "128/2"], ["129/1", "129/2"]]),
    ],
    ids=["one on USB", "one", "two"],
)
def test_a_board_on_usb_which_answers_to_every_address_is_one_board(line, motors):
    driver = find_driver("roboclaw")
    exchange, found = driver.exchange(ONE.settings), []
    for number, question in enumerate(driver.questions.frames):
        received = b"".join(board.receive(number * 100_000, exchange.request(question)) for board in line)
        found.append(exchange.reply(question, received))
    assert driver.recognise([reply for reply in found if reply is not None]) == {"motors": motors}


# The vendor's manual of the USB RoboClaw 2x120A HV, command 90; warnings and home switches stop nothing.
OLDER_STATUS = {
    0x0001: "", 0x0002: "", 0x0004: "e-stop input", 0x0008: "too hot", 0x0010: "too hot",
    0x0020: "main supply's voltage is too high", 0x0040: "logic supply's voltage is too high",
    0x0080: "logic supply's voltage is too low", 0x0100: "power stage of motor 1", 0x0200: "power stage of motor 2",
    0x0400: "", 0x0800: "", 0x1000: "", 0x2000: "", 0x4000: "", 0x8000: "",
}  # fmt: skip


@pytest.mark.parametrize(("bit", "expected"), OLDER_STATUS.items(), ids=map(hex, OLDER_STATUS))
def test_the_two_byte_status_of_older_firmware_has_a_layout_of_its_own(bit, expected):
    read, length = protocol.reply(0x80, "status", protocol.with_crc(b"\x80\x5a" + bit.to_bytes(2))[2:])
    board = Board(0x80, {"status": read})
    assert length == 4
    assert expected in board.error_text if expected else not board.errors


def test_a_board_with_the_two_byte_status_is_driven_and_its_e_stop_input_stops_it(bench):
    for board in boards(bench):
        board.registers.short_status = True
    drive(bench)
    boards(bench)[0].registers.status = 0x10000
    bench.run(0.3)
    assert bench.driver.state is DriverState.ARMED, "a warning"
    bench.robot.press_estop(True)
    bench.run(0.3)
    assert bench.driver.state is DriverState.ESTOP


def test_a_speed_beyond_what_the_board_can_do_is_held_to_it(bench):
    for board in boards(bench):
        board.registers.pid_m1 = board.registers.pid_m2 = (65536, 32768, 0, 6000)
    bench.drive(1.0, (50.0, 2.0))
    assert bench.robot.speed[0] == pytest.approx(6000 / ONE.settings.counts_per_rad, rel=1e-3)
    assert bench.driver.limits.max_wheel_speed_rad_s.value == pytest.approx(6000 / ONE.settings.counts_per_rad)


@pytest.mark.parametrize(
    ("baud", "rate_hz", "level"),
    [(38_400, 100.0, Level.FAIL), (38_400, 50.0, Level.WARNING), (115_200, 50.0, Level.OK)],
)
def test_a_line_that_is_too_slow_for_the_rate_is_refused(baud, rate_hz, level):
    link = Link(driver=ONE.name, kind="serial", baud=baud, of_driver=ONE.settings)
    assert check_link_load(link, Control(rate_hz=rate_hz)).level is level
