"""Framing on serial lines: the same frames as on CAN, between zero bytes, with COBS and a CRC-16 against line noise.

One serial frame is COBS([kind u8][can_id u16][data 0..8 bytes][CRC-16/CCITT-FALSE u16]) 0x00, little-endian.
COBS: Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.
"""

import binascii
from dataclasses import dataclass

from cobs import cobs

# A start bit, eight data bits and a stop bit (8N1).
BITS_PER_BYTE = 10
# Of this framing: the one kind there is, and the longest bytes between two delimiters that may be a frame.
KIND_CAN_FRAME = 1
MAX_FRAME = 64
# Of a classic CAN frame with an 11-bit identifier (ISO 11898-1).
MAX_CAN_ID = 0x7FF
MAX_DATA = 8
# Bytes of kind and identifier, and of the check sum.
_HEADER = 3
_CRC = 2


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE of `data`; the check value of b"123456789" is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode_frame(can_id: int, data: bytes) -> bytes:
    """Return the bytes of one frame on the line, its delimiter included.

    Raises ValueError for an identifier over 11 bits or more than 8 bytes of data.
    """
    if not 0 <= can_id <= MAX_CAN_ID:
        raise ValueError(f"CAN id {can_id:#x} is not an 11-bit identifier")
    if len(data) > MAX_DATA:
        raise ValueError(f"{len(data)} bytes of data; a classic CAN frame carries at most {MAX_DATA}")
    body = bytes((KIND_CAN_FRAME, can_id & 0xFF, can_id >> 8)) + data
    encoded: bytes = cobs.encode(body + crc16(body).to_bytes(2, "little"))
    return encoded + b"\0"


@dataclass(slots=True)
class FrameDecoderStats:
    """Counters of a decoder since it was created; every discarded byte is under one of these."""

    frames: int = 0
    bytes: int = 0
    stuffing_errors: int = 0
    crc_errors: int = 0
    length_errors: int = 0
    unknown_kind: int = 0

    @property
    def malformed(self) -> int:
        """Number of delimited pieces that were not a frame."""
        return self.stuffing_errors + self.crc_errors + self.length_errors + self.unknown_kind


class FrameDecoder:
    """Finds frames in a byte stream cut anywhere; after garbage it is in step again at the next delimiter."""

    __slots__ = ("_overlong", "_pending", "stats")

    def __init__(self) -> None:
        self.stats = FrameDecoderStats()
        self._pending = b""
        self._overlong = False

    def feed(self, received: bytes) -> list[tuple[int, bytes]]:
        """Take in received bytes and return the frames (CAN id, data) that they completed, oldest first."""
        self.stats.bytes += len(received)
        pieces = (self._pending + received).split(b"\0")
        self._pending = pieces.pop()
        frames: list[tuple[int, bytes]] = []
        for piece in pieces:
            overlong, self._overlong = self._overlong, False
            if overlong or len(piece) >= MAX_FRAME:
                self.stats.length_errors += 1
            elif piece and (frame := self._unwrap(piece)) is not None:
                frames.append(frame)
        if len(self._pending) >= MAX_FRAME:
            self._pending = b""
            self._overlong = True
        return frames

    def _unwrap(self, piece: bytes) -> tuple[int, bytes] | None:
        stats = self.stats
        try:
            body: bytes = cobs.decode(piece)
        except cobs.DecodeError:
            stats.stuffing_errors += 1
            return None
        if len(body) < _HEADER + _CRC:
            stats.length_errors += 1
            return None
        if crc16(body[:-_CRC]) != int.from_bytes(body[-_CRC:], "little"):
            stats.crc_errors += 1
            return None
        can_id = body[1] | body[2] << 8
        if body[0] != KIND_CAN_FRAME:
            stats.unknown_kind += 1
            return None
        if can_id > MAX_CAN_ID or len(body) > _HEADER + MAX_DATA + _CRC:
            stats.length_errors += 1
            return None
        stats.frames += 1
        return can_id, body[_HEADER:-_CRC]
