"""Tests that simulated ODrive and VESC act in their firmware's order: frames, control loop, timeout."""

import struct

import pytest

from sim.can_protocol import CanFrame
from sim.devices.odrive import CLOSED_LOOP, IDLE, INVALID_STATE, OdriveBoard
from sim.devices.vesc_firmware import Vesc, serial_packet
from tests.drivers.motor.vendors import VENDORS

ESTOP, SET_STATE, CLEAR = 0x02, 0x07, 0x18
ESTOP_BIT = 0x4000
NODES = (3, 5)


def armed_board():
    board = OdriveBoard("0.5", NODES)
    for axis in board.axes:
        axis.axis_state = CLOSED_LOOP
    return board


def send(board, node, command, data=b""):
    return board.receive(CanFrame(node << 5 | command, data))


def states(board):
    return [axis.axis_state for axis in board.axes]


def test_an_estop_frame_latches_the_error_alone_and_the_control_loop_releases_the_motor():
    board = armed_board()
    send(board, 3, ESTOP)
    axis = board.axes[0]
    assert (axis.axis_error, axis.axis_state, axis.disarm_reason) == (ESTOP_BIT, CLOSED_LOOP, 0)
    assert board.message(axis, 0x01).data[:5] == struct.pack("<IB", ESTOP_BIT, CLOSED_LOOP)
    board.step(1)
    assert (axis.axis_state, axis.disarm_reason) == (IDLE, ESTOP_BIT)
    assert states(board) == [IDLE, CLOSED_LOOP]


@pytest.mark.parametrize("node", NODES)
def test_clearing_errors_changes_no_state_of_a_board_that_is_armed_and_energises_nothing_that_was_released(node):
    board = armed_board()
    board.axes[0].motor_error = 16
    send(board, node, CLEAR)
    assert states(board) == [CLOSED_LOOP, CLOSED_LOOP]
    assert [(axis.axis_error, axis.motor_error, axis.disarm_reason) for axis in board.axes] == [(0, 0, 0)] * 2
    board.step(1)
    assert states(board) == [CLOSED_LOOP, CLOSED_LOOP]
    send(board, 3, ESTOP)
    board.step(2)
    send(board, node, CLEAR)
    for ms in (3, 4):
        board.step(ms)
    assert board.axes[0].axis_error == 0
    assert states(board) == [IDLE, CLOSED_LOOP]


def test_a_clear_in_the_millisecond_of_the_estop_comes_too_late_on_a_bus():
    rig = VENDORS[1].bench().robot.controller
    axis = rig.axes[0][0]
    axis.axis_state = CLOSED_LOOP
    for at_us, command in ((1000, ESTOP), (1400, CLEAR)):
        rig.receive(at_us, CanFrame(axis.node_id << 5 | command, b""))
    for board in rig.boards:
        board.step(2)
    assert (axis.axis_error, axis.axis_state) == (0, IDLE)


def test_a_request_clears_the_invalid_state_that_an_earlier_one_has_left():
    board = OdriveBoard("0.5", NODES)
    axis = board.axes[0]
    axis.calibrated = False
    send(board, 3, SET_STATE, struct.pack("<I", CLOSED_LOOP))
    board.step(1)
    assert (axis.axis_error, axis.axis_state) == (INVALID_STATE, IDLE)
    send(board, 3, SET_STATE, struct.pack("<I", IDLE))
    board.step(2)
    assert axis.axis_error == 0


STATUS_REQUEST = serial_packet(bytes((50,)) + (1 << 21).to_bytes(4))
SET_RPM = serial_packet(b"\x08" + (3000).to_bytes(4))


def status_byte(vesc):
    return vesc.receive_bytes(STATUS_REQUEST)[0][7]


def run_vesc(vesc, until_ms, events=()):
    """Milliseconds up to `until_ms`: what arrives in one comes before its check."""
    responses = {}
    for ms in range(until_ms + 1):
        vesc.at(ms)
        for at, received in events:
            if at == ms and (response := vesc.receive_bytes(received)[0]):
                responses[ms] = response[7]
        vesc.step(ms)
    return responses


def test_a_request_in_the_millisecond_of_a_check_reads_the_result_of_the_check_before():
    requests = [(ms, STATUS_REQUEST) for ms in (600, 609, 610, 611)]
    assert run_vesc(Vesc(1, 400), 620, [(200, SET_RPM), *requests]) == {600: 0, 609: 0, 610: 0, 611: 1}


def test_the_status_stays_timed_out_until_the_check_after_a_command():
    events = [(0, SET_RPM), (505, SET_RPM), (506, STATUS_REQUEST), (511, STATUS_REQUEST)]
    assert run_vesc(Vesc(1, 400), 520, events) == {506: 1, 511: 0}


def test_the_kill_switch_is_read_at_the_check_brakes_and_ignores_commands():
    vesc = Vesc(1, 400, timeout_brake_current_a=7.0)
    run_vesc(vesc, 5, [(0, SET_RPM)])
    vesc.kill_switch_pin = True
    assert status_byte(vesc) == 0
    vesc.step(10)
    assert (status_byte(vesc), vesc.last_command) == (2, ("set_brake_current", 7.0))
    vesc.at(15)
    vesc.receive_bytes(SET_RPM)
    assert vesc.last_command == ("set_brake_current", 7.0)
    vesc.kill_switch_pin = False
    vesc.step(20)
    assert status_byte(vesc) == 0
    vesc.at(31)
    vesc.receive_bytes(SET_RPM)
    assert vesc.last_command == ("set_erpm", 3000.0)


def test_the_timeout_is_neither_found_nor_ended_while_the_kill_switch_is_active():
    vesc = Vesc(1, 100)
    vesc.kill_switch_pin = True
    run_vesc(vesc, 300)
    assert status_byte(vesc) == 2
    vesc.kill_switch_pin = False
    vesc.step(310)
    assert status_byte(vesc) == 1
    vesc.kill_switch_pin = True
    vesc.at(312)
    vesc.receive_bytes(SET_RPM)
    vesc.step(320)
    assert status_byte(vesc) == 3
