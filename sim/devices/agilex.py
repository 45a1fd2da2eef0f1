"""An AgileX base (Scout, Scout Mini, Bunker, Tracer) on CAN v2: it takes speeds of the body, not of the wheels.

Lengths are not looked at, a mode that it does not know is taken as the number that it is, and the person with the
remote control comes first. Source: the vendor's ugv_sdk protocol_v2 and the Scout manual; no firmware of it ran.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.motor.agilex_protocol import AgilexSettings
from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.encoder_loop import EncoderLoop, EncoderUse

# By the manual.
TIMEOUT_MS = 500
STANDBY, CAN_MODE, UART_MODE, RC_MODE = range(4)
MOTORS = 8
"""Bases with steering have up to eight; those here send the first four."""
_PERIODS_MS = {0x221: 20, 0x311: 20, 0x251: 20, 0x261: 100, 0x241: 20, 0x361: 500}


@dataclass(slots=True)
class AgilexBase:
    """State of one base, of which `commanded` is what it follows now: speed (m/s) and turn rate (rad/s).

    It holds either to its own limit, whatever becomes of the curve: `max_speed_m_s` and `max_turn_rad_s`. `state_ms`:
    period of its state, 200 ms of a BUNKER PRO 2.0.
    """

    state_ms: int = 100
    max_speed_m_s: float = math.inf
    max_turn_rad_s: float = math.inf

    vehicle_state: int = 0
    control_mode: int = STANDBY
    battery_decivolt: int = 264
    error_code: int = 0
    speeds: tuple[int, int, int, int] = (0, 0, 0, 0)
    odometry_mm: tuple[int, int] = (0, 0)
    rpm: list[int] = field(default_factory=lambda: [0] * MOTORS)
    current_deciampere: list[int] = field(default_factory=lambda: [0] * MOTORS)
    pulses: list[int] = field(default_factory=lambda: [0] * MOTORS)
    driver_decivolt: list[int] = field(default_factory=lambda: [240] * MOTORS)
    driver_deg_c: list[int] = field(default_factory=lambda: [30] * MOTORS)
    motor_deg_c: list[int] = field(default_factory=lambda: [30] * MOTORS)
    driver_state: list[int] = field(default_factory=lambda: [0x40] * MOTORS)
    rc_switches: int = 0b10101010
    rc_sticks: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)
    rc_commanded: tuple[float, float] = (0.0, 0.0)
    brake: int = 0
    light: tuple[int, int, int, int, int] = (0, 0, 0, 0, 0)
    version: bytes = b"SIM-2.0\0"
    bms: tuple[int, int, int, int, int] = (80, 100, 264, -10, 250)
    bms_alarms: tuple[int, int, int, int] = (0, 0, 0, 0)
    motor_speeds: tuple[int, int, int, int] = (0, 0, 0, 0)
    count: int = 0
    last_motion_ms: int | None = None
    commanded_motion: tuple[int, int] = (0, 0)
    obeyed: list[tuple[int, tuple[int, ...]]] = field(default_factory=list)
    _now_ms: int = 0

    @property
    def commanded(self) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) that the base follows now."""
        if self.vehicle_state != 0:
            return 0.0, 0.0
        if self.control_mode == RC_MODE:
            return self.rc_commanded
        if self.control_mode != CAN_MODE or self.last_motion_ms is None:
            return 0.0, 0.0
        if self._now_ms - self.last_motion_ms > TIMEOUT_MS:
            return 0.0, 0.0
        linear, angular = (1e-3 * value for value in self.commanded_motion)
        return (
            min(max(linear, -self.max_speed_m_s), self.max_speed_m_s),
            min(max(angular, -self.max_turn_rad_s), self.max_turn_rad_s),
        )

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        """Take in one frame; return the replies."""
        if frame.extended or frame.remote or frame.error:
            return []
        data = frame.data.ljust(8, b"\0")
        match frame.can_id:
            case 0x111:
                linear, angular, lateral, steering = struct.unpack(">hhhh", data)
                self.obeyed.append((frame.can_id, (linear, angular, lateral, steering)))
                if self.control_mode == CAN_MODE:
                    self.commanded_motion, self.last_motion_ms = (linear, angular), self._now_ms
            case 0x121:
                self.light = struct.unpack(">BBBBB", data[:5])
                self.obeyed.append((frame.can_id, self.light))
            case 0x131:
                self.brake = data[0]
                self.obeyed.append((frame.can_id, (data[0],)))
            case 0x421:
                self.obeyed.append((frame.can_id, (data[0],)))
                # Who holds the remote control decides.
                if self.control_mode != RC_MODE:
                    self.control_mode = data[0]
                    self.commanded_motion, self.last_motion_ms = (0, 0), None
            case 0x441:
                self.obeyed.append((frame.can_id, (data[0],)))
                self.error_code = 0
                if self.vehicle_state == 2:
                    self.vehicle_state = 0
            case 0x411 | 0x4A1:
                if data[0] == 1:
                    return [self.message(0x4A1)]
        return []

    def use_remote_control(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Let an operator switch the remote control on and drive."""
        self.control_mode, self.rc_commanded = RC_MODE, (speed_m_s, turn_rad_s)

    def at(self, now_ms: int) -> None:
        """Say what time it is before a frame is given."""
        self._now_ms = now_ms

    def step(self, now_ms: int) -> list[CanFrame]:
        """Go through one millisecond; return the messages that are due."""
        self._now_ms = now_ms
        frames = []
        for can_id, period in ({0x211: self.state_ms} | _PERIODS_MS).items():
            if now_ms % period == 0:
                numbers = range(4) if can_id in (0x251, 0x261) else range(1)
                frames += [self.message(can_id + number) for number in numbers]
        return frames

    def message(self, can_id: int) -> CanFrame:
        """Return a message of the base by its identifier."""
        return CanFrame(can_id, self._body(can_id))

    def _body(self, can_id: int) -> bytes:
        match can_id:
            case 0x211:
                self.count = (self.count + 1) % 256
                state = (self.vehicle_state, self.control_mode, self.battery_decivolt, self.error_code)
                return struct.pack(">BBHHBB", *state, 0, (self.count - 1) % 256)
            case 0x221:
                return struct.pack(">hhhh", *self.speeds)
            case 0x231:
                return struct.pack(">BBBBBxxx", *self.light)
            case 0x241:
                return struct.pack(">Bbbbbbxx", self.rc_switches, *self.rc_sticks)
            case 0x311:
                return struct.pack(">ii", *self.odometry_mm)
            case 0x361:
                return struct.pack(">BBHhh", *self.bms)
            case 0x362:
                return struct.pack(">BBBB4x", *self.bms_alarms)
            case 0x281:
                return struct.pack(">hhhh", *self.motor_speeds)
            case 0x4A1:
                return self.version
        motor = (can_id & 0xF) - 1
        if can_id >> 4 == 0x25:
            return struct.pack(">hhi", self.rpm[motor], self.current_deciampere[motor], self.pulses[motor])
        temperatures = (self.driver_deg_c[motor], self.motor_deg_c[motor])
        return struct.pack(">HhbBxx", self.driver_decivolt[motor], *temperatures, self.driver_state[motor])


class AgilexController:
    """Controller of one AgileX base (a `virtual_robot.Controller`), which makes wheel speeds by its own track width."""

    brakes = False

    def __init__(self, settings: AgilexSettings, ticks_per_rev: int) -> None:
        self._settings = settings
        self._ticks_per_rev = ticks_per_rev
        self._ticks = self._zero_ticks = (0, 0)
        self.base = self._create_base()

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The speeds of its wheels: it always holds them."""
        linear, angular = self.base.commanded
        turn = 0.5 * self._settings.track_m * angular
        return (linear - turn) / self._settings.wheel_radius_m, (linear + turn) / self._settings.wheel_radius_m

    @property
    def regulates(self) -> bool:
        """Whether its wheels' loops run: in the modes in which somebody drives it, standing too."""
        return self.base.vehicle_state == 0 and self.base.control_mode in (CAN_MODE, RC_MODE)

    def create_loop(self) -> EncoderLoop:
        """Create the wheels' speed loops, assumed to be as simple as can be: the vendor documents nothing of them."""
        return EncoderLoop(EncoderUse.SPEED, self._settings.max_speed_m_s / self._settings.wheel_radius_m)

    @property
    def state(self) -> str:
        """State of the base in one word."""
        if self.base.vehicle_state or self.base.error_code:
            return "FAULT"
        return "ARMED" if self.base.control_mode == CAN_MODE else "STANDBY"

    @property
    def obeyed(self) -> int:
        """Number of commands accepted since power-on."""
        return len(self.base.obeyed)

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in one frame; return the replies."""
        self.base.at(now_us // 1000)
        return self.base.receive(frame)

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond; the odometry counts millimetres of each side from zero at the start."""
        base, radius = self.base, self._settings.wheel_radius_m
        self._ticks = (inputs.left_ticks, inputs.right_ticks)
        per_tick = 2e3 * math.pi * radius / self._ticks_per_rev
        left, right = (now - zero for now, zero in zip(self._ticks, self._zero_ticks, strict=True))
        base.odometry_mm = (round(per_tick * left), round(per_tick * right))
        linear = 0.5 * radius * (inputs.left_speed_rad_s + inputs.right_speed_rad_s)
        angular = radius * (inputs.right_speed_rad_s - inputs.left_speed_rad_s) / self._settings.track_m
        base.speeds = (round(1e3 * linear), round(1e3 * angular), 0, 0)
        if inputs.estop_button:
            base.vehicle_state = 1
        elif base.vehicle_state == 1:
            base.vehicle_state = 0
        return base.step(now_us // 1000)

    def restart(self) -> None:
        """Switch off and on: standby, nothing counted."""
        self._zero_ticks = self._ticks
        self.base = self._create_base()

    def _create_base(self) -> AgilexBase:
        return AgilexBase(max_speed_m_s=self._settings.max_speed_m_s, max_turn_rad_s=self._settings.max_turn_rad_s)


CONTROLLER = AgilexController
