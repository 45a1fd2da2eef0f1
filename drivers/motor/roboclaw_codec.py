"""RoboClaw packet serial: the bytes of a command and of its reply. Big-endian.

A command that sets something: address, command, arguments, CRC-16/XMODEM of all before; the reply is one byte, 0xFF,
or nothing. A command that asks: address and command alone; the reply is data and the CRC of address, command and data.
A reply names neither: it belongs to whoever asked last. Source: the vendor's user manual and its two host libraries.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

FIRST_ADDRESS, LAST_ADDRESS = 0x80, 0x87
ACKNOWLEDGE = b"\xff"
QUIET_S = 0.010
"""A pause of more than this between two bytes discards a packet that has begun."""
NVM_KEY = 0xE22EAB7A
_VERSION_END = b"\n\0"
_LONGEST_VERSION = 48
_CRC_BYTES = 2


@dataclass(frozen=True, slots=True)
class Layout:
    """A command's number, the bytes of its arguments or of its reply by `struct`, and the names of the fields."""

    command: int
    body: str
    fields: tuple[str, ...] = ()

    @property
    def length(self) -> int:
        """Of arguments or data in bytes, the CRC not counted."""
        return struct.calcsize(">" + self.body)


def _table(*layouts: tuple[str, int, str, str]) -> Mapping[str, Layout]:
    made = {name: Layout(command, body, tuple(names.split())) for name, command, body, names in layouts}
    return MappingProxyType(made)


SETTERS = _table(
    ("set_serial_timeout", 14, "B", "timeout_ds"),
    ("reset_encoders", 20, "", ""),
    ("set_velocity_pid_m1", 28, "IIII", "d p i qpps"),
    ("set_velocity_pid_m2", 29, "IIII", "d p i qpps"),
    ("duty_m1m2", 34, "hh", "duty_m1 duty_m2"),
    ("speed_m1", 35, "i", "speed_counts_s"),
    ("speed_m2", 36, "i", "speed_counts_s"),
    ("speed_m1m2", 37, "ii", "speed_m1_counts_s speed_m2_counts_s"),
    ("speed_accel_m1m2", 40, "Iii", "accel_counts_s2 speed_m1_counts_s speed_m2_counts_s"),
    ("write_nvm", 94, "I", "key"),
    ("reset_estop", 200, "", ""),
    ("set_estop_lock", 201, "B", "state"),
)
"""What a host may set. The driver uses duty_m1m2, speed_accel_m1m2 and, when asked to reset, reset_estop."""
GETTERS = _table(
    ("serial_timeout", 15, "B", "timeout_ds"),
    ("encoder_m1", 16, "iB", "encoder status"),
    ("encoder_m2", 17, "iB", "encoder status"),
    ("speed_of_m1", 18, "iB", "speed status"),
    ("speed_of_m2", 19, "iB", "speed status"),
    ("version", 21, "", "version"),
    ("raw_speed_of_m1", 30, "iB", "speed status"),
    ("raw_speed_of_m2", 31, "iB", "speed status"),
    ("main_battery", 24, "H", "main_battery_decivolt"),
    ("logic_battery", 25, "H", "logic_battery_decivolt"),
    ("pwms", 48, "hh", "pwm_m1 pwm_m2"),
    ("currents", 49, "hh", "current_m1_10ma current_m2_10ma"),
    ("velocity_pid_m1", 55, "IIII", "p i d qpps"),
    ("velocity_pid_m2", 56, "IIII", "p i d qpps"),
    ("encoders", 78, "ii", "encoder_m1 encoder_m2"),
    ("speeds", 79, "ii", "speed_m1 speed_m2"),
    ("temperature_1", 82, "H", "temperature_decidegree"),
    ("temperature_2", 83, "H", "temperature_decidegree"),
    ("status", 90, "I", "status_u32"),
    ("estop_lock", 202, "B", "estop_lock"),
)
GAIN_STEPS = 65536
"""Of a velocity gain in one unit; the order of the gains differs between setting and asking."""
_OLDER_STATUS = struct.Struct(">H")
_GETTER_BY_NUMBER = {layout.command: (name, layout) for name, layout in GETTERS.items()}
Value = float | int | str


def set_bytes(address: int, name: str, **values: int) -> bytes:
    """Return the bytes that set something; `values` by the names of `SETTERS`, held to what the wire can say.

    Raises ValueError for an address outside 0x80 to 0x87.
    """
    layout = SETTERS[name]
    arguments = [_held(values[field], code) for field, code in zip(layout.fields, layout.body, strict=True)]
    return with_crc(_head(address, layout.command) + struct.pack(">" + layout.body, *arguments))


def ask_bytes(address: int, name: str) -> bytes:
    """Return the bytes that ask for something. Raises ValueError for an address outside 0x80 to 0x87."""
    return _head(address, GETTERS[name].command)


def with_crc(packet: bytes) -> bytes:
    """Return the packet with the CRC of all its bytes."""
    return packet + binascii.crc_hqx(packet, 0).to_bytes(2)


def reply(address: int, name: str, received: bytes) -> tuple[Mapping[str, Value], int] | None:
    """Return the fields of the reply that `received` begins with and how many bytes it has; None if it is none yet.

    The status word has two bytes on older firmware and four on newer; a version text ends with a line feed and a zero.
    """
    layout = GETTERS[name]
    head = _head(address, layout.command)
    if name == "version":
        end = received.find(_VERSION_END, 0, _LONGEST_VERSION)
        if end < 0 or not _checks(head, received, end + 2):
            return None
        text = received[: end + 1].decode("ascii", "replace")
        return MappingProxyType({"version": text}), end + 2 + _CRC_BYTES
    if _checks(head, received, layout.length):
        fields = zip(layout.fields, struct.unpack_from(">" + layout.body, received), strict=True)
        return MappingProxyType(dict(fields)), layout.length + _CRC_BYTES
    older = name == "status" and len(received) == _OLDER_STATUS.size + _CRC_BYTES
    if older and _checks(head, received, _OLDER_STATUS.size):
        return MappingProxyType({"status_u32": _OLDER_STATUS.unpack_from(received)[0]}), len(received)
    return None


def getter_name(command: int) -> str | None:
    """Name of the command that asks with this number."""
    return _GETTER_BY_NUMBER[command][0] if command in _GETTER_BY_NUMBER else None


def reply_length(name: str) -> int:
    """Of a reply in bytes with its CRC; the longest that it can be where it varies."""
    return (_LONGEST_VERSION if name == "version" else GETTERS[name].length) + _CRC_BYTES


def _head(address: int, command: int) -> bytes:
    if not FIRST_ADDRESS <= address <= LAST_ADDRESS:
        raise ValueError(f"no RoboClaw address: {address:#x}")
    return bytes((address, command))


def _checks(head: bytes, received: bytes, length: int) -> bool:
    end = length + _CRC_BYTES
    if len(received) < end:
        return False
    return binascii.crc_hqx(head + received[:length], 0) == int.from_bytes(received[length:end])


def _held(value: int, code: str) -> int:
    bits = 8 * struct.calcsize(">" + code)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return min(max(value, low), high)
