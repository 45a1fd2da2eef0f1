"""A classic CAN frame: as a value, as SocketCAN bytes, as bits on the wire and as a candump line."""

from __future__ import annotations

import struct
from typing import NamedTuple

FRAME_BYTES = 16
ECHO_OWN_FRAMES = b"\x01"

ERROR_CONTROLLER = 0x004
ERROR_BUS_OFF = 0x040
ERROR_RESTARTED = 0x100
ERROR_COUNTERS = 0x200
RECEIVE_OVERFLOW = 0x01

_EXTENDED_FLAG = 0x8000_0000
_REMOTE_FLAG = 0x4000_0000
_ERROR_FLAG = 0x2000_0000
_EXTENDED_MASK = 0x1FFF_FFFF
_STANDARD_MASK = 0x7FF
_FRAME = struct.Struct("=IB3x8s")


class CanFrame(NamedTuple):
    """One classic CAN frame; `remote_length` is the length code of a remote frame, which carries no data."""

    can_id: int
    data: bytes = b""
    extended: bool = False
    remote: bool = False
    error: bool = False
    remote_length: int = 0


def pack_frame(frame: CanFrame) -> bytes:
    """The 16 bytes of Linux `struct can_frame` (include/uapi/linux/can.h), host byte order.

    Raises ValueError if the identifier or the data do not fit a classic frame.
    """
    can_id, data, extended, remote, error, remote_length = frame
    length = remote_length if remote else len(data)
    limit = _EXTENDED_MASK if extended or error else _STANDARD_MASK
    if not 0 <= can_id <= limit or length > 8 or len(data) > 8:
        raise ValueError(f"not a classic CAN frame: {frame}")
    if extended:
        can_id |= _EXTENDED_FLAG
    if remote:
        can_id |= _REMOTE_FLAG
    if error:
        can_id |= _ERROR_FLAG
    return _FRAME.pack(can_id, length, data)


def unpack_frame(packet: bytes) -> CanFrame | None:
    """The frame in a `struct can_frame`, or None if these bytes are none."""
    if len(packet) != FRAME_BYTES:
        return None
    can_id, length, data = _FRAME.unpack(packet)
    if length > 8:
        return None
    extended = bool(can_id & _EXTENDED_FLAG)
    error = bool(can_id & _ERROR_FLAG)
    if can_id & _REMOTE_FLAG:
        return CanFrame(can_id & _EXTENDED_MASK, b"", extended, True, error, length)
    mask = _EXTENDED_MASK if extended or error else _STANDARD_MASK
    return CanFrame(can_id & mask, data[:length], extended, False, error)
