"""An ODrive on CAN Simple: a board of firmware 0.5 with its axes, or one axis of 0.6.

What the open firmware 0.5.6 does with each frame, the weak parts included: any frame to a node feeds its watchdog, the
length and RTR of a command are not looked at, a velocity is taken with an error latched, and clearing the errors of one
axis clears those of the board. 0.6 is closed: the same is assumed of it, on one axis.
Source: odriverobotics/ODrive, communication/can/can_simple.cpp and MotorControl/axis.cpp at fw-v0.5.6.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from drivers.motor.odrive_protocol import OdriveSettings
from drivers.motor.vendor_parts import all_of, sides_of
from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.encoder_loop import EncoderLoop, EncoderUse

# The control loop of the open firmware runs at 8 kHz.
CHECKS_PER_MS = 8
# AxisState, ControlMode and InputMode of ODrive's API.
IDLE, CLOSED_LOOP, POSITION_CONTROL, VELOCITY_CONTROL, PASSTHROUGH = 1, 8, 3, 2, 1
WATCHDOG_ERROR = {"0.5": 0x800, "0.6": 0x0100_0000}
ESTOP_ERROR = {"0.5": 0x4000, "0.6": 0x0200_0000}
# AxisError of ODrive's API.
INVALID_STATE = 0x1
_F32 = struct.Struct("<f")


def f32(value: float) -> float:
    """Round to what a 32-bit float holds."""
    return float(_F32.unpack(_F32.pack(value))[0])


@dataclass(slots=True)
class Axis:
    """One axis, fields by what they hold in the firmware; turns are of the motor."""

    node_id: int
    axis_state: int = IDLE
    requested_state: int = 0
    axis_error: int = 0
    motor_error: int = 0
    encoder_error: int = 0
    controller_error: int = 0
    sensorless_error: int = 0
    disarm_reason: int = 0
    control_mode: int = POSITION_CONTROL
    input_mode: int = PASSTHROUGH
    input_pos_turns: float = 0.0
    input_vel_turns_s: float = 0.0
    input_torque_nm: float = 0.0
    vel_limit_turns_s: float = 100.0
    current_limit_a: float = 20.0
    traj_vel_limit: float = 2.0
    traj_accel_limit: float = 0.5
    traj_decel_limit: float = 0.5
    pos_gain: float = 20.0
    vel_gain: float = 0.16
    vel_integrator_gain: float = 0.33
    encoder_count: int = 0
    count_in_cpr: int = 0
    pos_turns: float = 0.0
    vel_turns_s: float = 0.0
    iq_setpoint_a: float = 0.0
    iq_measured_a: float = 0.0
    sensorless_pos: float = 0.0
    sensorless_vel: float = 0.0
    fet_deg_c: float = 30.0
    motor_deg_c: float = 30.0
    torque_target_nm: float = 0.0
    torque_estimate_nm: float = 0.0
    electrical_w: float = 0.0
    mechanical_w: float = 0.0
    procedure_result: int = 0
    calibrated: bool = True
    trajectory_done: bool = True
    watchdog_enabled: bool = False
    watchdog_timeout_s: float = 0.0
    watchdog_left: int = 0
    fed: int = 0
    obeyed_states: list[int] = field(default_factory=list)

    def feed(self) -> None:
        """Let the watchdog run anew."""
        self.fed += 1
        self.watchdog_left = int(f32(f32(self.watchdog_timeout_s) * 1000.0 * CHECKS_PER_MS))

    def check_watchdog(self, error: int, checks: int) -> None:
        """Run some of the 8 watchdog checks in a millisecond."""
        if not self.watchdog_enabled:
            return
        if self.watchdog_left < checks:
            self.axis_error |= error
        self.watchdog_left = max(0, self.watchdog_left - checks)

    def release_on_error(self) -> None:
        """Release a motor that runs with an error latched: the control loop's part, 8 times in a millisecond.

        A frame only latches or clears the error. What the control loop has released, clearing does not energise again.
        """
        if self.axis_error and self.axis_state != IDLE:
            self.disarm_reason = self.axis_error
            self.axis_state = IDLE

    def run_state_machine(self) -> None:
        """Take the requested state, once; with an error latched the axis stays idle.

        A request clears an INVALID_STATE that an earlier one has left.
        """
        requested, self.requested_state = self.requested_state, 0
        if requested == 0:
            return
        self.axis_error &= ~INVALID_STATE
        self.obeyed_states.append(requested)
        if requested == CLOSED_LOOP and not self.calibrated:
            self.axis_error |= INVALID_STATE
            self.axis_state = IDLE
        elif requested == CLOSED_LOOP and self.axis_error == 0:
            self.feed()
            self.axis_state = CLOSED_LOOP
        elif requested != CLOSED_LOOP:
            self.axis_state = requested

    @property
    def velocity_turns_s(self) -> float | None:
        """Commanded speed (turns/s) within the limit; None where the motor is released and coasts."""
        if self.axis_state != CLOSED_LOOP or self.control_mode != VELOCITY_CONTROL:
            return None
        return min(max(self.input_vel_turns_s, -self.vel_limit_turns_s), self.vel_limit_turns_s)


_CYCLIC = {
    "heartbeat": 0x01,
    "encoder": 0x09,
    "motor_error": 0x03,
    "encoder_error": 0x04,
    "controller_error": 0x1D,
    "sensorless_error": 0x05,
    "encoder_count": 0x0A,
    "iq": 0x14,
    "sensorless": 0x15,
    "bus_vi": 0x17,
}
PERIODS = tuple(_CYCLIC)
"""Cyclic messages in the order in which an axis sends those that are due."""
_WRITES: dict[int, tuple[str, tuple[str, ...]]] = {
    0x07: ("<i", ("requested_state",)),
    0x0B: ("<ii", ("control_mode", "input_mode")),
    0x0D: ("<ff", ("input_vel_turns_s", "input_torque_nm")),
    0x0E: ("<f", ("input_torque_nm",)),
    0x0F: ("<ff", ("vel_limit_turns_s", "current_limit_a")),
    0x11: ("<f", ("traj_vel_limit",)),
    0x12: ("<ff", ("traj_accel_limit", "traj_decel_limit")),
    0x1A: ("<f", ("pos_gain",)),
    0x1B: ("<ff", ("vel_gain", "vel_integrator_gain")),
}
"""By command: how its bytes are read, and the fields of the axis that they become."""


class OdriveBoard:
    """The axes of one board at their nodes, on a bus that they share."""

    def __init__(self, generation: str, nodes: Sequence[int], periods_ms: dict[str, int] | None = None) -> None:
        """Create a board of firmware `generation` "0.5" or "0.6".

        `periods_ms`: by the names of `PERIODS`, 0 for never; what is left out is as the firmware has it.
        """
        self.generation = generation
        self.axes = [Axis(node) for node in nodes]
        self.periods_ms = dict.fromkeys(PERIODS, 0) | {"heartbeat": 100, "encoder": 10} | (periods_ms or {})
        self.bus_v, self.bus_a = 24.0, 0.0
        self.version = (2, 4, 4, 58, 0, 6, 11, 0)
        self.parameters: dict[int, bytes] = {}
        self._sent_ms = {(axis.node_id, name): 0 for axis in self.axes for name in PERIODS}

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        """Take in one frame; return the replies."""
        if frame.extended or frame.error:
            return []
        node, command = frame.can_id >> 5, frame.can_id & 0x1F
        axis = next((axis for axis in self.axes if axis.node_id == node), None)
        if axis is None:
            return []
        data = frame.data.ljust(8, b"\0")
        axis.feed()
        if command == 0x1D and self.generation == "0.5":
            return [self.message(axis, command)]
        is_request = (frame.remote or not frame.data) and command != 0x01
        if is_request and self._telemetry_body(axis, command) is not None:
            return [self.message(axis, command)]
        if command == 0x04 and self.generation == "0.6":
            return self._parameter(axis, data)
        self._obey(axis, command, data)
        return []

    def _obey(self, axis: Axis, command: int, data: bytes) -> None:
        if command in _WRITES:
            layout, names = _WRITES[command]
            for name, value in zip(names, struct.unpack_from(layout, data), strict=True):
                setattr(axis, name, value)
            return
        match command:
            case 0x02:
                axis.axis_error |= ESTOP_ERROR[self.generation]
            case 0x06 if self.generation == "0.5":
                axis.node_id = struct.unpack_from("<I", data)[0]
            case 0x0C:
                axis.input_pos_turns, speed, torque = struct.unpack("<fhh", data)
                axis.input_vel_turns_s = f32(speed * f32(0.001))
                axis.input_torque_nm = f32(torque * f32(0.001))
            case 0x18:
                self.clear_errors()
            case 0x19 if self.generation == "0.5":
                axis.encoder_count = struct.unpack_from("<i", data)[0]
            case 0x19:
                axis.pos_turns = struct.unpack_from("<f", data)[0]

    def clear_errors(self) -> None:
        """Clear the errors of every axis of the board; none is energised again by that."""
        for axis in self.axes:
            axis.axis_error = axis.motor_error = axis.encoder_error = 0
            axis.controller_error = axis.sensorless_error = 0

    def check_watchdogs(self, checks: int = 1) -> Iterable[tuple[Axis, int]]:
        """Run some of the 8 checks in a millisecond; return the axes that failed by them and the error's bits."""
        failed = []
        for axis in self.axes:
            before = axis.axis_error
            axis.check_watchdog(WATCHDOG_ERROR[self.generation], checks)
            if axis.axis_error != before:
                failed.append((axis, axis.axis_error & ~before))
        self.release_on_error()
        return failed

    def release_on_error(self) -> None:
        """Run the part of the control loop that releases the motors of axes with an error."""
        for axis in self.axes:
            axis.release_on_error()

    def step(self, now_ms: int) -> list[CanFrame]:
        """Go through one millisecond: watchdogs, states, cyclic messages; return the frames to send."""
        self.check_watchdogs(CHECKS_PER_MS)
        for axis in self.axes:
            axis.run_state_machine()
        return self.cyclic(now_ms)

    def cyclic(self, now_ms: int) -> list[CanFrame]:
        """Return the frames due now, axis by axis."""
        frames = []
        for axis in self.axes:
            for name, command in _CYCLIC.items():
                period = self.periods_ms[name]
                if period > 0 and now_ms - self._sent_ms[axis.node_id, name] >= period:
                    self._sent_ms[axis.node_id, name] = now_ms
                    frames.append(self.message(axis, command))
        return frames

    def message(self, axis: Axis, command: int) -> CanFrame:
        """Return a telemetry message of an axis by its command number."""
        return CanFrame(axis.node_id << 5 | command, self._telemetry_body(axis, command) or b"")

    def _telemetry_body(self, axis: Axis, command: int) -> bytes | None:
        """Return the data of a message; None for a command that asks for none in this generation."""
        if command == 0x09:
            return struct.pack("<ff", axis.pos_turns, axis.vel_turns_s)
        if command == 0x14:
            return struct.pack("<ff", axis.iq_setpoint_a, axis.iq_measured_a)
        if command == 0x17:
            return struct.pack("<ff", self.bus_v, self.bus_a)
        return self._body_05(axis, command) if self.generation == "0.5" else self._body_06(axis, command)

    def _body_05(self, axis: Axis, command: int) -> bytes | None:
        match command:
            case 0x01:
                done = 0x80 if axis.trajectory_done else 0
                flags = (
                    int(axis.motor_error != 0),
                    int(axis.encoder_error != 0),
                    int(axis.controller_error != 0) | done,
                )
                return struct.pack("<IBBBB", axis.axis_error, axis.axis_state, *flags)
            case 0x03:
                return struct.pack("<Q", axis.motor_error)
            case 0x04:
                return struct.pack("<II", axis.encoder_error, 0)
            case 0x05:
                return struct.pack("<II", axis.sensorless_error, 0)
            case 0x0A:
                return struct.pack("<ii", axis.encoder_count, axis.count_in_cpr)
            case 0x15:
                return struct.pack("<ff", axis.sensorless_pos, axis.sensorless_vel)
            case 0x1D:
                return struct.pack("<II", axis.controller_error, 0)
        return None

    def _body_06(self, axis: Axis, command: int) -> bytes | None:
        match command:
            case 0x00:
                return bytes(self.version)
            case 0x01:
                result = (axis.procedure_result, axis.trajectory_done)
                return struct.pack("<IBBBx", axis.axis_error, axis.axis_state, *result)
            case 0x03:
                return struct.pack("<II", axis.axis_error, axis.disarm_reason)
            case 0x15:
                return struct.pack("<ff", axis.fet_deg_c, axis.motor_deg_c)
            case 0x1C:
                return struct.pack("<ff", axis.torque_target_nm, axis.torque_estimate_nm)
            case 0x1D:
                return struct.pack("<ff", axis.electrical_w, axis.mechanical_w)
        return None

    def _parameter(self, axis: Axis, data: bytes) -> list[CanFrame]:
        """Read or write a parameter by its endpoint; an unknown endpoint is not answered."""
        operation, endpoint, _ = struct.unpack_from("<BHB", data)
        if endpoint not in self.parameters:
            return []
        if operation == 1:
            self.parameters[endpoint] = data[4:]
            return []
        reply = struct.pack("<BHB", 0, endpoint, 0) + self.parameters[endpoint]
        return [CanFrame(axis.node_id << 5 | 0x05, reply)]


class OdriveController:
    """Controller of all axes of one robot (a `sim.virtual_robot.Controller`).

    Firmware 0.6 has a board for each axis.
    """

    brakes = False

    def __init__(self, settings: OdriveSettings, ticks_per_rev: int) -> None:
        self._settings = settings
        self._ticks_per_rev = ticks_per_rev
        self._received_us = 0
        self._saved = dict.fromkeys(all_of(settings.nodes), (True, settings.watchdog_s, settings.vel_limit_turns_s))
        self.boards = self._create_boards()
        self.axes = self._axes_by_side()

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The speeds that the motors hold; a side of which one motor is released has what the others hold."""
        wheels = []
        for side, direction in zip(self.axes, self._settings.direction, strict=True):
            known_speeds = [speed for axis in side if (speed := axis.velocity_turns_s) is not None]
            turns = sum(known_speeds) / len(known_speeds) if known_speeds else None
            wheels.append(None if turns is None else direction * turns * 2.0 * math.pi / self._settings.gear)
        return wheels[0], wheels[1]

    @property
    def regulates(self) -> bool:
        """Whether an axis is in closed loop."""
        return any(axis.axis_state == CLOSED_LOOP for side in self.axes for axis in side)

    def create_loop(self) -> EncoderLoop:
        """Create the field-oriented control, whose angle is the encoder's."""
        turns_s = self._settings.vel_limit_turns_s
        return EncoderLoop(EncoderUse.COMMUTATION, 2.0 * math.pi * turns_s / self._settings.gear)

    @property
    def state(self) -> str:
        """State of all axes in one word."""
        axes = [axis for side in self.axes for axis in side]
        if any(axis.axis_error for axis in axes):
            return "FAULT"
        return "ARMED" if any(axis.axis_state == CLOSED_LOOP for axis in axes) else "STANDBY"

    @property
    def obeyed(self) -> int:
        """Number of frames that the axes have accepted."""
        return sum(axis.fed for side in self.axes for axis in side)

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; return the replies."""
        if now_us - self._received_us >= 1000 // CHECKS_PER_MS:
            # The control loop ran between this frame and the one before: no clearing undoes what it has released.
            for board in self.boards:
                board.release_on_error()
        self._received_us = now_us
        return [reply for board in self.boards for reply in board.receive(frame)]

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond; an axis counts the turns of its motor from zero at its start."""
        ticks = (inputs.left_ticks, inputs.right_ticks)
        speeds = (inputs.left_speed_rad_s, inputs.right_speed_rad_s)
        gear = self._settings.gear
        for side, direction, counted, speed in zip(self.axes, self._settings.direction, ticks, speeds, strict=True):
            for axis in side:
                if inputs.estop_button:
                    axis.axis_error |= ESTOP_ERROR[self._settings.firmware]
                axis.pos_turns = f32(direction * gear * counted / self._ticks_per_rev)
                axis.vel_turns_s = f32(direction * gear * speed / (2.0 * math.pi))
        return [frame for board in self.boards for frame in board.step(now_us // 1000)]

    def save_configuration(self) -> None:
        """Keep what the axes are set to over a restart; the real board then restarts by itself."""
        self._saved = {
            axis.node_id: (axis.watchdog_enabled, axis.watchdog_timeout_s, axis.vel_limit_turns_s)
            for board in self.boards
            for axis in board.axes
        }

    def restart(self) -> None:
        """Switch off and on: nothing is asked, nothing latched, and what was set but not saved is lost."""
        self.boards = self._create_boards()
        self.axes = self._axes_by_side()

    def _create_boards(self) -> list[OdriveBoard]:
        settings = self._settings
        left, right = sides_of(settings.nodes)
        pairs = list(zip(left, right, strict=True)) if settings.firmware == "0.5" else [(n,) for n in (*left, *right)]
        periods = {"heartbeat": round(1000.0 * settings.heartbeat_s), "encoder": 10}
        boards = [OdriveBoard(settings.firmware, nodes, periods) for nodes in pairs]
        for axis in (axis for board in boards for axis in board.axes):
            saved = self._saved[axis.node_id]
            axis.watchdog_enabled, axis.watchdog_timeout_s, axis.vel_limit_turns_s = saved
        if settings.watchdog_endpoints is not None:
            enabled, timeout = settings.watchdog_endpoints
            for board in boards:
                is_on, timeout_s, _ = self._saved[board.axes[0].node_id]
                board.parameters = {enabled: struct.pack("<?3x", is_on), timeout: struct.pack("<f", timeout_s)}
        return boards

    def _axes_by_side(self) -> tuple[list[Axis], list[Axis]]:
        by_node = {axis.node_id: axis for board in self.boards for axis in board.axes}
        left, right = sides_of(self._settings.nodes)
        return [by_node[node] for node in left], [by_node[node] for node in right]


CONTROLLER = OdriveController
