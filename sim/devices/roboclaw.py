"""A RoboClaw on packet serial: its registers, and what it answers to which bytes.

Every packet whose CRC is right feeds the serial timeout, those that only ask too. What is malformed is not answered,
and a pause of more than 10 ms discards what has begun. Source: the vendor's user manual and host libraries; no firmware
of it ran.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass

QUIET_US = 10_000


@dataclass(slots=True)
class RoboclawRegisters:
    """What a host can set and read; motor 1 and 2. Counts wrap at 2^32."""

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
    estop_lock: int = 0x55
    pid_m1: tuple[int, int, int, int] = (65536, 32768, 0, 100_000)
    pid_m2: tuple[int, int, int, int] = (65536, 32768, 0, 100_000)
    version: str = "USB Roboclaw 2x30a v4.3.6\n"
    nvm_writes: int = 0
    short_status: bool = False


class Roboclaw:
    """One board at `address`.

    `command` is what the motors are to do: "speed" in counts/s (with `accel` in counts/s^2, None for as fast as it
    can), "duty" in 1/32767, or None when nobody has said or the timeout has stopped them.
    """

    def __init__(self, address: int = 0x80) -> None:
        self.address = address
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
                body, act = _SETTERS[command]
                length = 2 + struct.calcsize(">" + body) + 2
                if len(self._pending) < length:
                    break
                packet = bytes(self._pending[:length])
                del self._pending[:length]
                if binascii.crc_hqx(packet[:-2], 0) != int.from_bytes(packet[-2:]):
                    # What is behind cannot be told apart from it.
                    self._pending.clear()
                    break
                if address == self.address:
                    arguments = struct.unpack(">" + body, packet[2:-2])
                    self._feed(now_us)
                    self.obeyed.append((command, arguments))
                    act(self, arguments)
                    out += b"\xff"
            elif command in _GETTERS:
                del self._pending[:2]
                if address == self.address:
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

    def _set_timeout(self, arguments: tuple[int, ...]) -> None:
        self.registers.timeout_ds = arguments[0]

    def _reset_encoders(self, _arguments: tuple[int, ...]) -> None:
        self.registers.encoder_m1 = self.registers.encoder_m2 = 0

    def _set_pid_m1(self, arguments: tuple[int, ...]) -> None:
        d, p, i, qpps = arguments
        self.registers.pid_m1 = (p, i, d, qpps)

    def _set_pid_m2(self, arguments: tuple[int, ...]) -> None:
        d, p, i, qpps = arguments
        self.registers.pid_m2 = (p, i, d, qpps)

    def _write_nvm(self, arguments: tuple[int, ...]) -> None:
        self.registers.nvm_writes += arguments[0] == 0xE22EAB7A

    def _reset_estop(self, _arguments: tuple[int, ...]) -> None:
        if self.registers.estop_lock == 0xAA:
            self.registers.status &= ~1

    def _set_estop_lock(self, arguments: tuple[int, ...]) -> None:
        self.registers.estop_lock = arguments[0]


_Act = Callable[[Roboclaw, tuple[int, ...]], None]
_SETTERS: dict[int, tuple[str, _Act]] = {
    14: ("B", Roboclaw._set_timeout),
    20: ("", Roboclaw._reset_encoders),
    28: ("IIII", Roboclaw._set_pid_m1),
    29: ("IIII", Roboclaw._set_pid_m2),
    34: ("hh", lambda board, a: board._drive("duty", a[0], a[1])),
    35: ("i", lambda board, a: board._drive_one(0, a[0])),
    36: ("i", lambda board, a: board._drive_one(1, a[0])),
    37: ("ii", lambda board, a: board._drive("speed", a[0], a[1])),
    40: ("Iii", lambda board, a: board._drive("speed", a[1], a[2], a[0])),
    94: ("I", Roboclaw._write_nvm),
    200: ("", Roboclaw._reset_estop),
    201: ("B", Roboclaw._set_estop_lock),
}


def _counts(*values: int) -> bytes:
    return b"".join((value & 0xFFFF_FFFF).to_bytes(4) for value in values)


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
    82: lambda r: r.temperature_1.to_bytes(2),
    83: lambda r: r.temperature_2.to_bytes(2),
    90: lambda r: (r.status & 0xFFFF).to_bytes(2) if r.short_status else r.status.to_bytes(4),
    202: lambda r: bytes([r.estop_lock]),
}
