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

from drivers.motor.vendor_parts import Decoded, by_number, layout, layouts
from drivers.types import Frame

# comm_can of the firmware: identifier 255 is all controllers; packets have at most PACKET_MAX_PL_LEN bytes.
EVERYBODY = 255
LARGEST_ID = 254
MAX_PAYLOAD = 512
# Values are 32-bit integers on the wire.
_I32 = (-(2**31), 2**31 - 1)

CAN_COMMANDS: Mapping[str, tuple[int, float]] = MappingProxyType(
    {
        "set_duty": (0, 1e5),
        "set_current": (1, 1e3),
        "set_brake_current": (2, 1e3),
        "set_erpm": (3, 1.0),
        "set_position": (4, 1e6),
        "set_current_rel": (10, 1e5),
        "set_brake_current_rel": (11, 1e5),
        "set_handbrake": (12, 1e3),
        "set_handbrake_rel": (13, 1e5),
    }
)
"""By name: command number, and steps in a unit (duty, A, electrical rpm, degrees). Each moves or brakes at once."""
PACKET_COMMANDS: Mapping[str, tuple[int, float]] = MappingProxyType(
    {
        "set_duty": (5, 1e5),
        "set_current": (6, 1e3),
        "set_brake_current": (7, 1e3),
        "set_erpm": (8, 1.0),
        "set_position": (9, 1e6),
        "set_handbrake": (10, 1e3),
    }
)
# COMM_PACKET_ID of datatypes.h.
GET_VALUES, GET_APPCONF, ALIVE, FORWARD_CAN, GET_VALUES_SELECTIVE = 4, 17, 30, 34, 50
_TIMEOUT = struct.Struct(">BIBIf")
# CAN_PACKET_ID of datatypes.h; FILL frames have one byte of offset, up to 255, and FILL_LONG frames two.
PING, PONG = 17, 18
FILL, FILL_LONG, PROCESS, PROCESS_SHORT = 5, 6, 7, 8
_FILL_BYTES, _FILL_REACH, _LONG_BYTES, _SHORT_BYTES = 7, 255, 6, 6


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
VALUES = tuple(
    layout(">", "values", GET_VALUES, body, fields)
    for body, fields in (
        ("h", "t_fet_c:10"),
        ("h", "t_motor_c:10"),
        ("i", "current_motor_a:100"),
        ("i", "current_in_a:100"),
        ("i", "id_a:100"),
        ("i", "iq_a:100"),
        ("h", "duty:1000"),
        ("i", "erpm"),
        ("h", "v_in:10"),
        ("i", "ah:1e4"),
        ("i", "ah_charged:1e4"),
        ("i", "wh:1e4"),
        ("i", "wh_charged:1e4"),
        ("i", "tachometer"),
        ("i", "tachometer_abs"),
        ("B", "fault"),
        ("i", "pid_pos_deg:1e6"),
        ("B", "controller_id"),
        ("hhh", "t_mos1_c:10 t_mos2_c:10 t_mos3_c:10"),
        ("i", "vd_v:1000"),
        ("i", "vq_v:1000"),
        ("B", "status_byte"),
    )
)
"""Of COMM_GET_VALUES, in the order of the bits of the selective form's mask."""
# Bits of the mask of COMM_GET_VALUES_SELECTIVE, and of the status byte that it returns.
FAULT_AND_STATUS = 1 << 15 | 1 << 21
ALL_OF_A_MOTOR = 1 << 7 | 1 << 13 | 1 << 17 | FAULT_AND_STATUS
TIMED_OUT, KILL_SWITCH = 1, 2


def can_frame(command: int, controller: int, data: bytes) -> Frame:
    """Return the frame of a command. Raises ValueError for a controller above 255."""
    if not 0 <= controller <= EVERYBODY:
        raise ValueError(f"no VESC: {controller}")
    return Frame(command << 8 | controller, data, extended=True)


def command(controller: int, name: str, value: float) -> Frame:
    """Return the frame of one of `CAN_COMMANDS`, always of four bytes: rounded, held to what the wire can say."""
    number, steps = CAN_COMMANDS[name]
    return can_frame(number, controller, struct.pack(">i", _steps(value, steps)))


def ping(controller: int, host: int) -> Frame:
    """Ask whether a controller is there; it answers with "pong", and its timeout is not fed."""
    return can_frame(PING, controller, bytes([host]))


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


def packet_command(name: str, value: float) -> bytes:
    """Return the payload of one of `PACKET_COMMANDS`."""
    number, steps = PACKET_COMMANDS[name]
    return struct.pack(">Bi", number, _steps(value, steps))


def request_values(mask: int) -> bytes:
    """Return the payload that asks for some of a controller's values; it feeds no timeout."""
    return struct.pack(">BI", GET_VALUES_SELECTIVE, mask)


def forward(controller: int, payload: bytes) -> bytes:
    """Return the payload that makes the controller on the serial line pass `payload` to another one on its CAN."""
    return bytes([FORWARD_CAN, controller]) + payload


def values(payload: bytes) -> Mapping[str, float] | None:
    """Return the values in an answer to GET_VALUES or its selective form; None for what is no whole answer."""
    if payload[:1] == bytes([GET_VALUES]):
        mask, offset = (1 << len(VALUES)) - 1, 1
    elif payload[:1] == bytes([GET_VALUES_SELECTIVE]) and len(payload) >= 5:
        mask, offset = int.from_bytes(payload[1:5]), 5
    else:
        return None
    found: dict[str, float] = {}
    for bit, part in enumerate(VALUES):
        if mask >> bit & 1:
            if len(payload) < offset + part.length:
                return None
            found |= part.unpack(payload, offset)
            offset += part.length
    return MappingProxyType(found)


def timeout(payload: bytes, controller: int) -> tuple[float, float] | None:
    """Return the timeout (s, 0 is off) and its brake current (A) in a controller's answer to GET_APPCONF; else None.

    They stand behind the signature and the controller's id since firmware 4; what has another id there is laid out
    otherwise.
    """
    if len(payload) < _TIMEOUT.size or payload[0] != GET_APPCONF:
        return None
    _, _, answering, timeout_ms, brake_current_a = _TIMEOUT.unpack_from(payload)
    return (1e-3 * timeout_ms, brake_current_a) if answering == controller else None


def fragments(controller: int, sender: int, payload: bytes, send_mode: int = 0) -> tuple[Frame, ...]:
    """Return the CAN frames that carry a packet to a controller; `send_mode` 0 asks it to answer to `sender`."""
    if len(payload) <= _SHORT_BYTES:
        return (can_frame(PROCESS_SHORT, controller, bytes([sender, send_mode]) + payload),)
    frames = []
    at = 0
    while at < len(payload):
        if at < _FILL_REACH:
            frames.append(can_frame(FILL, controller, bytes([at]) + payload[at : at + _FILL_BYTES]))
            at += _FILL_BYTES
        else:
            frames.append(can_frame(FILL_LONG, controller, struct.pack(">H", at) + payload[at : at + _LONG_BYTES]))
            at += _LONG_BYTES
    end = struct.pack(">BBHH", sender, send_mode, len(payload), crc(payload))
    return (*frames, can_frame(PROCESS, controller, end))


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


class PacketDecoder:
    """The packets in a stream of bytes; what is none is skipped byte by byte, and counted."""

    def __init__(self) -> None:
        self._pending = bytearray()
        self.skipped = 0

    def feed(self, received: bytes) -> list[bytes]:
        """Take in bytes as they come; return the payloads of the packets that they complete."""
        self._pending += received
        found = []
        at = 0
        while at < len(self._pending):
            length = self._length(at)
            if length is None:
                break
            end = at + length
            if length == 0 or not self._is_complete(at, end):
                at += 1
                self.skipped += 1
                continue
            found.append(bytes(self._pending[at + self._pending[at] : end - 3]))
            at = end
        del self._pending[:at]
        return found

    def _length(self, at: int) -> int | None:
        """Return the length of the packet that begins here: 0 if none does, None if more bytes are needed."""
        pending = self._pending
        start = pending[at]
        if start not in (2, 3):
            return 0
        if len(pending) - at < start:
            return None
        payload = int.from_bytes(pending[at + 1 : at + start])
        # A length that fits one byte is not said with two.
        if not (255 if start == 3 else 1) <= payload <= MAX_PAYLOAD:
            return 0
        packet_end = start + payload + 3
        return packet_end if len(pending) - at >= packet_end else None

    def _is_complete(self, at: int, end: int) -> bool:
        pending = self._pending
        payload = bytes(pending[at + pending[at] : end - 3])
        return pending[end - 1] == 3 and int.from_bytes(pending[end - 3 : end - 1]) == crc(payload)


def _steps(value: float, steps: float) -> int:
    low, high = _I32
    return min(max(round(value * steps), low), high)
