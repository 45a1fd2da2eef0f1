"""How much of the link a protocol's cyclic frames take."""

from __future__ import annotations

from collections.abc import Iterable

from drivers.types import CyclicFrame

_SERIAL_BITS_PER_BYTE = 10
_SERIAL_OVERHEAD_BYTES = 7


def worst_case_bits(length: int) -> int:
    """Return the bit times of a classic CAN frame with 11-bit identifier and `length` bytes, interframe space included.

    With the most stuff bits that its content can need: 55 + 10 n, which is 135 for 8 bytes (ISO 11898-1: one after
    each four of the 34 + 8 n bits that are stuffed, the first excepted).
    """
    return 47 + 8 * length + (34 + 8 * length - 1) // 4


def can_load(frames: Iterable[CyclicFrame], bitrate: int) -> float:
    """Return the part of a CAN bus at `bitrate` (bit/s) that the frames take, every one with the most stuff bits."""
    return sum(worst_case_bits(frame.length) * frame.rate_hz for frame in frames) / bitrate


def serial_load(frames: Iterable[CyclicFrame], baud: int) -> float:
    """Return the part of a serial line at `baud` (bit/s) that the frames take in the busier of its two directions.

    A frame is tunnelled with 7 bytes of kind, identifier, CRC, stuffing and delimiter; a byte is 10 bits on the line.
    """
    taken: dict[str, float] = {}
    for frame in frames:
        bits = (frame.length + _SERIAL_OVERHEAD_BYTES) * _SERIAL_BITS_PER_BYTE
        taken[frame.sender] = taken.get(frame.sender, 0.0) + bits * frame.rate_hz
    return max(taken.values(), default=0.0) / baud
