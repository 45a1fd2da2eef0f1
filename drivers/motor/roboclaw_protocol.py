"""Packet serial of RoboClaw boards: the bytes of a command and of its reply. Big-endian.

A command that sets something: address, command, arguments, CRC-16/XMODEM of all before; the reply is one byte, 0xFF,
or nothing. A command that asks: address and command alone; the reply is data and the CRC of address, command and data.
A reply names neither: it belongs to whoever asked last. Source: the vendor's user manual and its two host libraries.

What robot.toml says of the boards follows, with exchange, e-stop, line load and safety card.
"""

from __future__ import annotations

import binascii
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from drivers.motor.vendor_parts import Sign, by_number, in_sides, layouts
from drivers.types import CyclicFrame, Frame, LineQuestions, SafetyCard, SettingsFault

# User manual, packet serial: eight addresses; the version is at most 48 bytes; CRC-16 ends every reply.
FIRST_ADDRESS, LAST_ADDRESS = 0x80, 0x87
ACKNOWLEDGE = b"\xff"
_VERSION_END = b"\n\0"
_LONGEST_VERSION = 48
_CRC_BYTES = 2


SETTERS = layouts(
    ">",
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
GETTERS = layouts(
    ">",
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
    ("default_duty_accels", 81, "II", "decel_m1 decel_m2"),
    ("temperature_1", 82, "H", "temperature_decidegree"),
    ("temperature_2", 83, "H", "temperature_decidegree"),
    ("status", 90, "I", "status_u32"),
    ("estop_lock", 202, "B", "estop_lock"),
)
GAIN_STEPS = 65536
"""Of a velocity gain in one unit; the order of the gains differs between setting and asking."""
_OLDER_STATUS = struct.Struct(">H")
# Of each motor the acceleration, then the deceleration, by the vendor's newer library.
_NEWER_DUTY_ACCELS = struct.Struct(">4xI4xI")
_GETTER_BY_NUMBER = by_number(GETTERS)
Value = float | int | str


def setting(address: int, name: str, **values: int) -> Frame:
    """Return the packet that sets something; `values` by the names of `SETTERS`, held to what the wire can say.

    Raises ValueError for an address outside 0x80 to 0x87.
    """
    layout = SETTERS[name]
    arguments = [_in_range(values[field], code) for field, code in zip(layout.fields, layout.body, strict=True)]
    packet = with_crc(_head(address, layout.command) + layout.pack(*arguments))
    return Frame(address << 8 | layout.command, packet)


def query(address: int, name: str) -> Frame:
    """Return the packet that asks for something. Raises ValueError for an address outside 0x80 to 0x87."""
    command = GETTERS[name].command
    return Frame(address << 8 | command, _head(address, command))


def with_crc(packet: bytes) -> bytes:
    """Return the packet with the CRC of all its bytes."""
    return packet + binascii.crc_hqx(packet, 0).to_bytes(2)


def reply(address: int, name: str, received: bytes) -> tuple[Mapping[str, Value], int] | None:
    """Return the fields of the reply that `received` begins with and how many bytes it has; None if it is none yet.

    The status word, of two bytes on older firmware, is returned as the four of newer; a version text ends with a line
    feed and a zero.
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
        return MappingProxyType(layout.unpack(received)), layout.length + _CRC_BYTES
    newer = name == "default_duty_accels"
    if newer and _checks(head, received, _NEWER_DUTY_ACCELS.size):
        decels = _NEWER_DUTY_ACCELS.unpack_from(received)
        return MappingProxyType(dict(zip(layout.fields, decels, strict=True))), _NEWER_DUTY_ACCELS.size + _CRC_BYTES
    older = name == "status" and len(received) == _OLDER_STATUS.size + _CRC_BYTES
    if older and _checks(head, received, _OLDER_STATUS.size):
        return MappingProxyType({"status_u32": _in_32_bits(*_OLDER_STATUS.unpack_from(received))}), len(received)
    return None


def getter_name(command: int) -> str | None:
    """Name of the command that asks with this number."""
    return _GETTER_BY_NUMBER[command].name if command in _GETTER_BY_NUMBER else None


def _in_32_bits(older: int) -> int:
    """Return an older status of 16 bits as a newer one of 32.

    Lowest are two warnings of current, then the errors, then the other warnings and the home switches.
    """
    return (older & 0x3) << 16 | (older & 0x3FC) >> 2 | (older & 0xFC00) << 8


def _head(address: int, command: int) -> bytes:
    if not FIRST_ADDRESS <= address <= LAST_ADDRESS:
        raise ValueError(f"no RoboClaw address: {address:#x}")
    return bytes((address, command))


def _checks(head: bytes, received: bytes, length: int) -> bool:
    end = length + _CRC_BYTES
    if len(received) < end:
        return False
    return binascii.crc_hqx(head + received[:length], 0) == int.from_bytes(received[length:end])


def _in_range(value: int, code: str) -> int:
    bits = 8 * struct.calcsize(">" + code)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if code.islower() else (0, (1 << bits) - 1)
    return min(max(value, low), high)


# Estimate of how long a board takes to answer, for the load of the line alone.
_TURNAROUND_S = 0.0009
_MOTOR = re.compile(r"(\d{1,3})/([12])")
EXAMPLE = """motors = ["128/1", "128/2"]
counts_per_rev = 8192.0
direction = [1, -1]
watchdog_s = 0.2
"""
_Motors = str | tuple[str, ...]


class RoboclawSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of RoboClaw boards in [link]: left before right.

    `motors`: "ADDRESS/MOTOR", address 128 to 135, motor 1 or 2, one or more a side. `counts_per_rev`: of the encoder a
    wheel turn, gear included. `watchdog_s`: the serial timeout, which the driver sets before each arming, in steps of
    0.1 s. `acceleration_rad_s2`: what the boards ramp a wheel with.
    """

    motors: tuple[_Motors, _Motors]
    counts_per_rev: Annotated[float, Meta(gt=0.0, le=1e7)]
    watchdog_s: Annotated[float, Meta(ge=0.1, le=0.5)]
    direction: tuple[Sign, Sign] = (1, 1)
    acceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=1000.0)] = 100.0
    stop_deceleration_rad_s2: Annotated[float, Meta(gt=0.0, le=655.0)] = 10.0

    @property
    def sides(self) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[int, int], ...]]:
        """Address and motor (0 or 1) of each motor, on the left and on the right."""
        left, right = ((side,) if isinstance(side, str) else side for side in self.motors)
        return tuple(map(_place, left)), tuple(map(_place, right))

    @property
    def addresses(self) -> tuple[int, ...]:
        """Addresses of the boards, each once."""
        return tuple(dict.fromkeys(address for side in self.sides for address, _ in side))

    @property
    def counts_per_rad(self) -> float:
        """Encoder counts in a radian of the wheel."""
        return self.counts_per_rev / (2.0 * math.pi)

    @property
    def timeout_ds(self) -> int:
        """The serial timeout in the boards' steps of 0.1 s."""
        return round(10.0 * self.watchdog_s)

    def fault(self) -> SettingsFault | None:
        """Return what is wrong with the fields taken together, or None."""
        named = [name for side in self.motors for name in ((side,) if isinstance(side, str) else side)]
        wrong = [name for name in named if not _is_place(name)]
        if wrong or not named or () in self.motors:
            found = f'"{wrong[0]}" is no motor' if wrong else "a side has no motor"
            return SettingsFault(
                "motors", found, 'write [left, right] such as ["128/1", "128/2"], addresses 128 to 135'
            )
        places = [place for side in self.sides for place in side]
        if len(set(places)) != len(places):
            return SettingsFault("motors", "a motor is listed twice", "write each once")
        if abs(10.0 * self.watchdog_s - self.timeout_ds) > 1e-6:
            return SettingsFault("watchdog_s", f"{self.watchdog_s:g} is not a multiple of 0.1", "write 0.2")
        return None


@dataclass(frozen=True, slots=True)
class RoboclawExchange:
    """Exchange with RoboClaw boards (a `drivers.types.Exchange`); `can_id` is address and command, data the packet."""

    timeout_s: float = 0.02
    quiet_s: float = 0.012

    def request(self, frame: Frame) -> bytes:
        """Return the packet as it stands."""
        return frame.data

    def is_answered(self, _frame: Frame) -> bool:
        """Return True, because every packet is answered, by one byte or by what it asks for."""
        return True

    def reply(self, frame: Frame, received: bytes) -> Frame | None:
        """Return the reply whole, with the CRC that fits this request alone; of a packet that sets something 0xFF."""
        address, command = divmod(frame.can_id, 256)
        name = getter_name(command)
        if name is None:
            return Frame(frame.can_id, ACKNOWLEDGE) if received[:1] == ACKNOWLEDGE else None
        found = reply(address, name, received)
        return None if found is None else Frame(frame.can_id, received[: found[1]])


QUESTIONS = LineQuestions(
    tuple(query(address, "version") for address in range(FIRST_ADDRESS, LAST_ADDRESS + 1)), (115_200, 38_400)
)
"""The version, of each address; at the usual speeds of a UART, of which USB takes any. They feed a serial timeout."""


def recognise(frames: Sequence[Frame]) -> dict[str, Any] | None:
    """Return the motors of the boards that reported their version.

    One board has both sides, of several the first half is left. A board on USB answers to every address.
    """
    version = GETTERS["version"].command
    queries = [(frame.can_id >> 8, frame) for frame in frames if frame.can_id & 0xFF == version and not frame.extended]
    boards = sorted(
        {
            address
            for address, frame in queries
            if FIRST_ADDRESS <= address <= LAST_ADDRESS and reply(address, "version", frame.data) is not None
        }
    )
    if len(boards) == len(QUESTIONS.frames):
        del boards[1:]
    motors = [f"{address}/{motor}" for address in boards for motor in (1, 2)]
    return {"motors": in_sides(motors)} if motors else None


def stop_frames(settings: RoboclawSettings) -> tuple[Frame, ...]:
    """Zero duty for every board, and the question whether its motors stand; nothing latches it."""
    return (
        *(setting(address, "duty_m1m2", duty_m1=0, duty_m2=0) for address in settings.addresses),
        *(query(address, "encoders") for address in settings.addresses),
    )


def cyclic_frames(settings: RoboclawSettings, command_rate_hz: float, _authenticated: bool) -> tuple[CyclicFrame, ...]:
    """Return the frames of each period: a command and the counts of each board, and one question more."""
    each = {"speed command": 16 + 1, "encoders": 2 + 10}
    frames = [
        CyclicFrame(f"{name} of {address}", "LINE", length, command_rate_hz, length, _TURNAROUND_S)
        for address in settings.addresses
        for name, length in each.items()
    ]
    return (*frames, CyclicFrame("status", "LINE", 8, command_rate_hz, 8, _TURNAROUND_S))


def safety_card(settings: RoboclawSettings) -> SafetyCard:
    """Return the safety card of RoboClaw boards."""
    return SafetyCard(
        host_silent=f"each board, {settings.watchdog_s:g} s after the last packet of any kind, by its serial "
        "timeout, which is set and read back before each arming",
        stops_by="stopping both motors; whether they brake or coast is set in the board",
        reaction_s=settings.watchdog_s,
        brakes=False,
        estop="through the daemon first, as two hosts must not send at once; zero duty for every board; only this "
        "driver latches the stop, and only motors at rest confirm it: wire a button to S3, S4 or S5",
        wheel_fault="zero duty for every motor at once, which needs no encoder; the board's PID, which runs to full "
        "speed with a lost encoder, receives no more speeds",
        unverified=(
            "whether a stopped motor brakes or coasts; which packets feed the timeout is taken from the manual",
            "not tested on hardware: the driver was tested against a simulator made from the manual and the "
            "vendor's host libraries",
        ),
        setup=(
            "Motion Studio: packet serial at link.baud, each board its own address, encoders and velocity PID tuned "
            "(QPPS is taken as the fastest speed); Default Accel 655359, with which zero duty is ramped",
        ),
    )


def _is_place(name: str) -> bool:
    found = _MOTOR.fullmatch(name)
    return found is not None and FIRST_ADDRESS <= int(found[1]) <= LAST_ADDRESS


def _place(name: str) -> tuple[int, int]:
    address, _, motor = name.partition("/")
    return int(address), int(motor) - 1
