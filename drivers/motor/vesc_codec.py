"""VESC over CAN and over a serial line: frames, packets and what they mean. Big-endian throughout.

CAN: 29-bit identifier, command << 8 | controller. What is longer than a frame goes as a packet in fragments.
Serial: 0x02 and one length byte, or 0x03 and two, then the payload, its CRC-16 and 0x03. Source: the vendor's
documentation/comm_can.md and what its firmware 7.01 does.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Mapping
from types import MappingProxyType

from drivers.motor.vendor_parts import Decoded, by_number, layouts
from drivers.types import Frame

# comm_can of the firmware: identifier 255 is all controllers; packets have at most PACKET_MAX_PL_LEN bytes.
EVERYBODY = 255
LARGEST_ID = 254
MAX_PAYLOAD = 512
# By the first byte of a packet: its shortest payload, as a length that fits one byte is not said with two.
_SHORTEST = {2: 1, 3: 255}
# Values are 32-bit integers on the wire.
_I32 = (-(2**31), 2**31 - 1)

COMMANDS: Mapping[str, tuple[int, int, float]] = MappingProxyType(
    {"set_current": (1, 6, 1e3), "set_brake_current": (2, 7, 1e3), "set_erpm": (3, 8, 1.0)}
)
"""By name: number on CAN, number in a packet, and steps in a unit (A, electrical rpm)."""
SET_COMMANDS = frozenset({0, 1, 2, 3, 4, 10, 11, 12, 13})
"""Numbers on CAN of all commands that move or brake a motor: duty, current, brake, speed, position, and shares."""
# COMM_PACKET_ID of datatypes.h.
GET_APPCONF, FORWARD_CAN, GET_VALUES_SELECTIVE = 17, 34, 50
_TIMEOUT = struct.Struct(">BIBIf")
# CAN_PACKET_ID of datatypes.h; FILL frames have one byte of offset, FILL_LONG frames two.
PING, PONG = 17, 18
FILL, FILL_LONG, PROCESS, PROCESS_SHORT = 5, 6, 7, 8


_STATUS = by_number(
    layouts(
        ">",
        ("status", 9, "ihh", "erpm current_a:10 duty:1000"),
        ("status2", 14, "ii", "ah:1e4 ah_charged:1e4"),
        ("status3", 15, "ii", "wh:1e4 wh_charged:1e4"),
        ("status4", 16, "hhhh", "t_fet_c:10 t_motor_c:10 current_in_a:10 pid_pos_deg:50"),
        ("status5", 27, "ihxx", "tachometer v_in:10"),
        ("status6", 58, "hhhh", "adc1_v:1000 adc2_v:1000 adc3_v:1000 ppm:1000"),
    )
)
_VALUES = {
    7: ("erpm", "i"),
    13: ("tachometer", "i"),
    15: ("fault", "B"),
    17: ("controller_id", "B"),
    21: ("status_byte", "B"),
}
"""Of COMM_GET_VALUES_SELECTIVE what is asked for: by the bit of its mask the name and the `struct` code.

The last one is sent by firmware 5.03 and later; older firmware repeats the mask without it.
"""
FAULT_AND_STATUS = 1 << 15 | 1 << 21
ALL_OF_A_MOTOR = sum(1 << bit for bit in _VALUES)
# Bits of the status byte.
TIMED_OUT, KILL_SWITCH = 1, 2


def _frame(number: int, controller: int, data: bytes) -> Frame:
    return Frame(number << 8 | controller, data, extended=True)


def command(controller: int, name: str, value: float) -> Frame:
    """Return the frame of one of `COMMANDS`: rounded to steps of 32 bits, held to what the wire can say."""
    number, _, steps = COMMANDS[name]
    low, high = _I32
    return _frame(number, controller, struct.pack(">i", min(max(round(value * steps), low), high)))


def ping(controller: int, host: int) -> Frame:
    """Ask whether a controller is there; it answers with "pong", and its timeout is not fed."""
    return _frame(PING, controller, bytes([host]))


def decode(frame: Frame) -> Decoded | None:
    """Return what a controller says of itself; None for anything else, and for a frame that is too short."""
    if not frame.extended:
        return None
    number, controller = frame.can_id >> 8, frame.can_id & 0xFF
    if number == PONG and len(frame.data) >= 1:
        return Decoded("pong", MappingProxyType({}), frame.data[0])
    status = _STATUS.get(number)
    if status is None or len(frame.data) != status.length:
        return None
    return Decoded(status.name, status.unpack(frame.data), controller)


def request_values(mask: int) -> bytes:
    """Return the payload that asks for some of a controller's values; it feeds no timeout."""
    return struct.pack(">BI", GET_VALUES_SELECTIVE, mask)


def forward(controller: int, payload: bytes) -> bytes:
    """Return the payload that makes the controller on the serial line pass `payload` to another one on its CAN."""
    return bytes([FORWARD_CAN, controller]) + payload


def values(payload: bytes) -> Mapping[str, int] | None:
    """Return the values in an answer to `request_values`; None for what is no whole one, or has others."""
    if payload[:1] != bytes([GET_VALUES_SELECTIVE]) or len(payload) < 5:
        return None
    mask = int.from_bytes(payload[1:5])
    requested = [each for bit, each in _VALUES.items() if mask >> bit & 1]
    form = struct.Struct(">" + "".join(code for _, code in requested))
    if mask & ~ALL_OF_A_MOTOR or len(payload) < 5 + form.size:
        return None
    return {name: value for (name, _), value in zip(requested, form.unpack_from(payload, 5), strict=True)}


def timeout(payload: bytes, controller: int) -> tuple[float, float] | None:
    """Return the timeout (s, 0 is off) and its brake current (A) in a controller's answer to GET_APPCONF; else None.

    They stand behind the signature and the controller's id since firmware 4; what has another id there is laid out
    otherwise.
    """
    if len(payload) < _TIMEOUT.size or payload[0] != GET_APPCONF:
        return None
    _, _, answering, timeout_ms, brake_current_a = _TIMEOUT.unpack_from(payload)
    return (1e-3 * timeout_ms, brake_current_a) if answering == controller else None


def packet_frame(controller: int, sender: int, payload: bytes) -> Frame:
    """Return the CAN frame that carries a packet of at most 6 bytes to a controller, which answers to `sender`."""
    return _frame(PROCESS_SHORT, controller, bytes([sender, 0]) + payload)


class Reassembly:
    """The packets that come to one CAN identifier in fragments, from any number of senders one after the other."""

    def __init__(self, node_id: int) -> None:
        self._node_id = node_id
        self._buffer = bytearray(MAX_PAYLOAD)

    def feed(self, frame: Frame) -> tuple[int, int, bytes] | None:
        """Take in a frame; return sender, send mode and payload of the packet that it completes, if it does."""
        number, to = frame.can_id >> 8, frame.can_id & 0xFF
        data = frame.data
        if not frame.extended or to != self._node_id:
            return None
        if number == FILL and len(data) >= 1:
            self._insert(data[0], data[1:])
        elif number == FILL_LONG and len(data) >= 2:
            self._insert(int.from_bytes(data[:2]), data[2:])
        elif number == PROCESS_SHORT and len(data) >= 2:
            return data[0], data[1], data[2:]
        elif number == PROCESS and len(data) == 6:
            sender, mode, length, checksum = struct.unpack(">BBHH", data)
            payload = bytes(self._buffer[:length])
            if len(payload) == length and crc(payload) == checksum:
                return sender, mode, payload
        return None

    def _insert(self, at: int, data: bytes) -> None:
        if at + len(data) <= MAX_PAYLOAD:
            self._buffer[at : at + len(data)] = data


def crc(payload: bytes) -> int:
    """Return the CRC-16/XMODEM of a payload."""
    return binascii.crc_hqx(payload, 0)


def packet(payload: bytes) -> bytes:
    """Return the bytes of a packet on the serial line. Raises ValueError for an empty payload, or above 512 bytes."""
    if not 1 <= len(payload) <= MAX_PAYLOAD:
        raise ValueError(f"not a VESC payload: {len(payload)} bytes")
    head = struct.pack(">BB", 2, len(payload)) if len(payload) <= 255 else struct.pack(">BH", 3, len(payload))
    return head + payload + struct.pack(">HB", crc(payload), 3)


def packets(received: bytes) -> list[bytes]:
    """Return the payloads of the whole packets in these bytes; what is none is skipped byte by byte."""
    found: list[bytes] = []
    at = 0
    while at < len(received):
        # A packet begins with the number of bytes before its payload.
        begin = at + received[at]
        length = int.from_bytes(received[at + 1 : begin])
        end = begin + length + 3
        is_packet = received[at] in _SHORTEST
        if is_packet and begin <= len(received):
            is_packet = _SHORTEST[received[at]] <= length <= MAX_PAYLOAD
        if is_packet and len(received) < end:
            # The rest of it is still on its way.
            break
        payload = received[begin : end - 3]
        if is_packet and received[end - 3 : end] == struct.pack(">HB", crc(payload), 3):
            found.append(payload)
            at = end
        else:
            at += 1
    return found
