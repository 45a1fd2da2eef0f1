"""A classic CAN frame as a value, as SocketCAN bytes and as a candump line."""

from __future__ import annotations

import struct

import msgspec

FRAME_BYTES = 16
"""Length of Linux `struct can_frame`."""
ECHO_OWN_FRAMES = b"\x01"
"""Packet by which a client of the hub asks for its own frames as well."""

_EXTENDED_FLAG = 0x8000_0000
_REMOTE_FLAG = 0x4000_0000
_ERROR_FLAG = 0x2000_0000
_EXTENDED_MASK = 0x1FFF_FFFF
_STANDARD_MASK = 0x7FF
_FRAME = struct.Struct("=IB3x8s")


class CanFrame(msgspec.Struct, frozen=True, gc=False):
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
    can_id, data = frame.can_id, frame.data
    length = frame.remote_length if frame.remote else len(data)
    limit = _EXTENDED_MASK if frame.extended or frame.error else _STANDARD_MASK
    if not 0 <= can_id <= limit or length > 8 or len(data) > 8:
        raise ValueError(f"not a classic CAN frame: {frame}")
    if frame.extended:
        can_id |= _EXTENDED_FLAG
    if frame.remote:
        can_id |= _REMOTE_FLAG
    if frame.error:
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


def candump_line(t_ns: int, channel: str, frame: CanFrame) -> str:
    """The frame as `candump -L` writes it, for example `(0.000270) can0 110#8D300000`; `t_ns` is printed in seconds."""
    width = 8 if frame.extended or frame.error else 3
    can_id = frame.can_id | _ERROR_FLAG if frame.error else frame.can_id
    body = f"R{frame.remote_length}" if frame.remote else frame.data.hex().upper()
    seconds, rest_ns = divmod(t_ns, 1_000_000_000)
    return f"({seconds}.{rest_ns // 1000:06d}) {channel} {can_id:0{width}X}#{body}"


def controller_error_frame(tec: int, rec: int, state: int) -> CanFrame:
    """Error frame CAN_ERR_CRTL | CAN_ERR_CNT: `state` is the CAN_ERR_CRTL_* bits, the counters go to bytes 6 and 7."""
    return CanFrame(0x204, bytes((0, state, 0, 0, 0, 0, min(tec, 255), min(rec, 255))), error=True)


def bus_off_frame() -> CanFrame:
    """Error frame CAN_ERR_BUSOFF: this node has left the bus."""
    return CanFrame(0x040, bytes(8), error=True)


def restarted_frame() -> CanFrame:
    """Error frame CAN_ERR_RESTARTED: this node has come back from bus-off."""
    return CanFrame(0x100, bytes(8), error=True)


def protocol_error_frame() -> CanFrame:
    """Error frame CAN_ERR_PROT | CAN_ERR_BUSERROR: a frame was destroyed on the wire."""
    return CanFrame(0x088, bytes(8), error=True)


def receive_overflow_frame() -> CanFrame:
    """Error frame CAN_ERR_CRTL with CAN_ERR_CRTL_RX_OVERFLOW: this reader was too slow and frames are lost."""
    return CanFrame(0x004, bytes((0, 0x01, 0, 0, 0, 0, 0, 0)), error=True)
