"""A RoboClaw on packet serial: its registers, and what it answers to which bytes.

Every packet whose CRC is right feeds the serial timeout, those that only ask too. What is malformed is not answered,
and a pause of more than 10 ms discards what has begun. Source: the vendor's user manual and host libraries; no firmware
of it ran.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.motor.roboclaw_protocol import RoboclawSettings
from firmware_protocol.firmware_core import FirmwareInputs
from sim.can_protocol import CanFrame
from sim.encoder_loop import EncoderLoop, EncoderUse

# User manual, packet serial: a longer pause discards what has begun.
QUIET_US = 10_000


@dataclass(slots=True)
class RoboclawRegisters:
    """Registers that a host can set and read; motor 1 and 2. Counts wrap at 2^32.

    `estop_lock`: what ends a latched e-stop: 0x55 its release, 0xAA a reset, all else only switching the board off and
    on, as it comes from the factory.
    """

    timeout_ds: int = 0
    encoder_m1: int = 0
    encoder_m2: int = 0
    speed_m1: int = 0
    speed_m2: int = 0
    raw_speed_m1: int = 0
    raw_speed_m2: int = 0
    encoder_m1_status: int = 0
    encoder_m2_status: int = 0
    main_battery_decivolt: int = 240
    logic_battery_decivolt: int = 50
    pwm_m1: int = 0
    pwm_m2: int = 0
    current_m1_10ma: int = 0
    current_m2_10ma: int = 0
    temperature_1: int = 300
    temperature_2: int = 300
    status: int = 0
    estop_lock: int = 0x00
    duty_accel_m1: int = 655_360
    duty_accel_m2: int = 655_360
    pid_m1: tuple[int, int, int, int] = (65536, 32768, 0, 100_000)
    pid_m2: tuple[int, int, int, int] = (65536, 32768, 0, 100_000)
    version: str = "USB Roboclaw 2x30a v4.3.6\n"
    nvm_writes: int = 0
    short_status: bool = False
    has_duty_decel: bool = False


class Roboclaw:
    """One board at `address`; on USB it takes each packet for its own, whatever address of 0x80 to 0x87 that has.

    `command` is what the motors are to do: "speed" in counts/s (with `accel` in counts/s^2, None for as fast as it
    can), "duty" in 1/32767, or None when nobody has said or the timeout has stopped them.
    """

    def __init__(self, address: int = 0x80, *, is_on_usb: bool = False) -> None:
        self.address = address
        self.is_on_usb = is_on_usb
        self.registers = RoboclawRegisters()
        self.command: tuple[str, float, float] | None = None
        self.accel: float | None = None
        self.fed = 0
        self.obeyed: list[tuple[int, tuple[int, ...]]] = []
        self._pending = bytearray()
        self._last_byte_us = 0
        self._fed_us = 0

    def receive(self, now_us: int, received: bytes) -> bytes:
        """Take in bytes that came at a time; return the reply."""
        if self._pending and now_us - self._last_byte_us > QUIET_US:
            self._pending.clear()
        self._last_byte_us = now_us
        self._pending += received
        out = bytearray()
        while len(self._pending) >= 2:
            address, command = self._pending[0], self._pending[1]
            if command in _SETTERS:
                body = _SETTERS[command]
                length = 2 + struct.calcsize(">" + body) + 2
                if len(self._pending) < length:
                    break
                packet = bytes(self._pending[:length])
                del self._pending[:length]
                if binascii.crc_hqx(packet[:-2], 0) != int.from_bytes(packet[-2:]):
                    # What follows cannot be distinguished from it.
                    self._pending.clear()
                    break
                if self._is_meant(address):
                    arguments = struct.unpack(">" + body, packet[2:-2])
                    self._feed(now_us)
                    self.obeyed.append((command, arguments))
                    self._obey(command, arguments)
                    out += b"\xff"
            elif command in _GETTERS:
                del self._pending[:2]
                if self._is_meant(address):
                    self._feed(now_us)
                    data = _GETTERS[command](self.registers)
                    out += data + binascii.crc_hqx(bytes((address, command)) + data, 0).to_bytes(2)
            else:
                self._pending.clear()
        return bytes(out)

    def step(self, now_us: int) -> None:
        """Stop both motors when the serial timeout has run out."""
        timeout_us = self.registers.timeout_ds * 100_000
        if timeout_us and now_us - self._fed_us > timeout_us:
            self.command = None

    def _is_meant(self, address: int) -> bool:
        return 0x80 <= address <= 0x87 if self.is_on_usb else address == self.address

    def _feed(self, now_us: int) -> None:
        self.fed += 1
        self._fed_us = now_us

    def _drive(self, kind: str, first: float, second: float, accel: float | None = None) -> None:
        if not self.registers.status & 1:
            self.command, self.accel = (kind, first, second), accel

    def _drive_one(self, motor: int, speed: int) -> None:
        speeds = [0.0, 0.0] if self.command is None or self.command[0] != "speed" else list(self.command[1:])
        speeds[motor] = speed
        self._drive("speed", *speeds)

    def _obey(self, command: int, arguments: tuple[int, ...]) -> None:
        registers, a = self.registers, arguments
        match command:
            case 14:
                registers.timeout_ds = a[0]
            case 20:
                registers.encoder_m1 = registers.encoder_m2 = 0
            case 28:
                registers.pid_m1 = (a[1], a[2], a[0], a[3])
            case 29:
                registers.pid_m2 = (a[1], a[2], a[0], a[3])
            case 34:
                self._drive("duty", a[0], a[1])
            case 35 | 36:
                self._drive_one(command - 35, a[0])
            case 37:
                self._drive("speed", a[0], a[1])
            case 40:
                self._drive("speed", a[1], a[2], a[0])
            case 68 | 69:
                setattr(registers, f"duty_accel_m{command - 67}", a[0])
            case 94:
                registers.nvm_writes += a[0] == 0xE22EAB7A
            case 200 if registers.estop_lock == 0xAA:
                registers.status &= ~1
            case 201:
                registers.estop_lock = a[0]


_SETTERS = {
    14: "B", 20: "", 28: "IIII", 29: "IIII", 34: "hh", 35: "i", 36: "i", 37: "ii", 40: "Iii",
    68: "I", 69: "I", 94: "I", 200: "", 201: "B",
}  # fmt: skip
"""By command: how its arguments are packed. Those of a velocity PID are D, P, I, QPPS."""


def _counts(*values: int) -> bytes:
    return b"".join((value & 0xFFFF_FFFF).to_bytes(4) for value in values)


_SHORT_STATUS = (
    0x10000, 0x20000, 0x1, 0x2, 0x4, 0x8, 0x10, 0x20, 0x40, 0x80, 0x40000, 0x80000, 0x100000, 0x200000, 0x400000,
    0x800000,
)  # fmt: skip
"""Status of boards with 16 bits, from the lowest on: which bit of the 32 means the same (manuals, command 90)."""


def _short_status(status: int) -> int:
    """Return the status as an older board sends it; what that does not know is left out."""
    return sum(1 << number for number, bit in enumerate(_SHORT_STATUS) if status & bit)


_GETTERS: dict[int, Callable[[RoboclawRegisters], bytes]] = {
    15: lambda r: bytes([r.timeout_ds]),
    16: lambda r: _counts(r.encoder_m1) + bytes([r.encoder_m1_status]),
    17: lambda r: _counts(r.encoder_m2) + bytes([r.encoder_m2_status]),
    18: lambda r: _counts(r.speed_m1) + bytes([r.encoder_m1_status]),
    19: lambda r: _counts(r.speed_m2) + bytes([r.encoder_m2_status]),
    21: lambda r: r.version.encode() + b"\0",
    24: lambda r: r.main_battery_decivolt.to_bytes(2),
    25: lambda r: r.logic_battery_decivolt.to_bytes(2),
    30: lambda r: _counts(r.raw_speed_m1) + bytes([r.encoder_m1_status]),
    31: lambda r: _counts(r.raw_speed_m2) + bytes([r.encoder_m2_status]),
    48: lambda r: struct.pack(">hh", r.pwm_m1, r.pwm_m2),
    49: lambda r: struct.pack(">hh", r.current_m1_10ma, r.current_m2_10ma),
    55: lambda r: _counts(*r.pid_m1),
    56: lambda r: _counts(*r.pid_m2),
    78: lambda r: _counts(r.encoder_m1, r.encoder_m2),
    79: lambda r: _counts(r.speed_m1, r.speed_m2),
    81: lambda r: b"".join(
        _counts(*(2 if r.has_duty_decel else 1) * (accel,)) for accel in (r.duty_accel_m1, r.duty_accel_m2)
    ),
    82: lambda r: r.temperature_1.to_bytes(2),
    83: lambda r: r.temperature_2.to_bytes(2),
    90: lambda r: _short_status(r.status).to_bytes(2) if r.short_status else r.status.to_bytes(4),
    202: lambda r: bytes([r.estop_lock]),
}


class RoboclawController:
    """All boards of a robot on one serial line: satisfies `virtual_robot.Controller`; frames carry the line's bytes.

    Motors whose command has ended, by the serial timeout or an error, coast; zero duty brakes, after the ramp of the
    default duty acceleration. `dead`: addresses of
    boards without supply.
    """

    def __init__(self, settings: RoboclawSettings, ticks_per_rev: int) -> None:
        self._settings = settings
        self._sides = settings.sides
        self._counts_per_tick = settings.counts_per_rev / ticks_per_rev
        self.boards = {address: Roboclaw(address) for address in settings.addresses}
        self.dead: set[int] = set()
        self._ticks = self._zero_ticks = (0, 0)
        self._measured = (0.0, 0.0)
        self._ramped: dict[tuple[int, int], float] = {}
        self._counted: tuple[deque[int], deque[int]] = (deque(maxlen=4), deque(maxlen=4))

    @property
    def wheels_rad_s(self) -> tuple[float | None, float | None]:
        """The mean of what a side's motors hold; None where one is released."""
        known_speeds: list[float | None] = []
        counts_per_rad = self._settings.counts_per_rad
        for side, direction in zip(self._sides, self._settings.direction, strict=True):
            known = [self._ramped[place] for place in side if place in self._ramped]
            is_known = len(known) == len(side)
            known_speeds.append(direction * sum(known) / len(side) / counts_per_rad if is_known else None)
        return known_speeds[0], known_speeds[1]

    @property
    def brakes(self) -> bool:
        """Whether zero duty shorts every motor."""
        return all(board.command == ("duty", 0, 0) for board in self.boards.values())

    @property
    def regulates(self) -> bool:
        """Whether a motor has a speed to hold; a fixed duty needs no encoder."""
        return any(board.command is not None and board.command[0] == "speed" for board in self.boards.values())

    def create_loop(self) -> EncoderLoop:
        """Create the velocity PID, which full duty (QPPS) ends."""
        qpps = min(board.registers.pid_m1[3] for board in self.boards.values())
        return EncoderLoop(EncoderUse.SPEED, qpps / self._settings.counts_per_rad)

    @property
    def state(self) -> str:
        """State of all boards in one word."""
        if any(board.registers.status & 0xFFFF for board in self.boards.values()):
            return "FAULT"
        return "STANDBY" if all(board.command is None for board in self.boards.values()) else "ARMED"

    @property
    def obeyed(self) -> int:
        """Number of speed commands that the boards have accepted."""
        return sum(command in _MOVING for board in self.boards.values() for command, _ in board.obeyed)

    def receive(self, now_us: int, frame: CanFrame) -> Sequence[CanFrame]:
        """Take in bytes from the line, which every board hears; return what one of them replies."""
        replies = [
            board.receive(now_us, frame.data) for address, board in self.boards.items() if address not in self.dead
        ]
        return [CanFrame(0, reply) for reply in replies if reply]

    def step(self, now_us: int, inputs: FirmwareInputs) -> Sequence[CanFrame]:
        """Go through one millisecond: the encoders count, timeouts run, speeds are ramped."""
        self._ticks = (inputs.left_ticks, inputs.right_ticks)
        self._measured = (inputs.left_speed_rad_s, inputs.right_speed_rad_s)
        counts_per_rad = self._settings.counts_per_rad
        for number, (side, direction) in enumerate(zip(self._sides, self._settings.direction, strict=True)):
            ticks = self._ticks[number] - self._zero_ticks[number]
            count = round(direction * ticks * self._counts_per_tick)
            speed = direction * self._measured[number] * counts_per_rad
            self._counted[number].append(count)
            # In steps of 300 counts/s: what was counted in the last 1/300 s, as long as three steps and a little.
            counts_s = 300 * (count - self._counted[number][0])
            for address, motor in side:
                registers = self.boards[address].registers
                if motor == 0:
                    registers.encoder_m1, registers.speed_m1 = count, counts_s
                else:
                    registers.encoder_m2, registers.speed_m2 = count, counts_s
                self._ramp(address, motor, speed)
        for board in self.boards.values():
            if inputs.estop_button:
                board.registers.status |= 1
            elif board.registers.estop_lock == 0x55:
                board.registers.status &= ~1
            if board.registers.status & 0xFFFF:
                board.command = None
            board.step(now_us)
        return ()

    def restart(self) -> None:
        """Switch off and on: counts, commands and a timeout that was not stored are gone."""
        self._zero_ticks = self._ticks
        self.boards = {address: Roboclaw(address) for address in self._settings.addresses}

    def _ramp(self, address: int, motor: int, measured_counts_s: float) -> None:
        board, place = self.boards[address], (address, motor)
        if board.command is None or address in self.dead:
            self._ramped.pop(place, None)
            return
        kind, *values = board.command
        target = values[motor]
        if kind == "duty":
            # By the default duty acceleration, in 1/32767 of full duty a second; a released motor has no duty.
            accel = (board.registers.duty_accel_m1, board.registers.duty_accel_m2)[motor]
            per_duty = (board.registers.pid_m1, board.registers.pid_m2)[motor][3] / 32767.0
            now, step = self._ramped.get(place, 0.0), 1e-3 * accel * per_duty
            self._ramped[place] = now + min(max(target * per_duty - now, -step), step)
            return
        now = self._ramped.get(place, measured_counts_s)
        step = math.inf if board.accel is None else 1e-3 * board.accel
        self._ramped[place] = now + min(max(target - now, -step), step)


_MOVING = frozenset({34, 35, 36, 37, 40})


CONTROLLER = RoboclawController
