"""How much of the link the protocol's cyclic frames take, computed from the DBC's cycle times."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from firmware_protocol.dbc import load_protocol

_COMMANDS = ("WHEEL_COMMAND", "WHEEL_COMMAND_MAC")
_AUTHENTICATION = ("WHEEL_COMMAND_MAC", "HOST_STATE_MAC", "MAC_CHALLENGE")
_SERIAL_BITS_PER_BYTE = 10
_SERIAL_OVERHEAD_BYTES = 7


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """A frame of `length` data bytes that `sender` sends `rate_hz` times a second."""

    name: str
    sender: str
    length: int
    rate_hz: float


def cyclic_frames(dbc: str, command_rate_hz: float, *, authenticated: bool = False) -> tuple[CyclicFrame, ...]:
    """Return all frames with a cycle time (GenMsgCycleTime, ms) in the DBC's text, each page of a multiplexed one.

    The wheel command counts at the rate of the control loop; proofs and their challenge only if `authenticated`.
    """
    frames = []
    for message in load_protocol(dbc).messages:
        if message.period_s is not None and (authenticated or message.name not in _AUTHENTICATION):
            pages = {signal.page for signal in message.signals} - {None}
            rate_hz = command_rate_hz if message.name in _COMMANDS else 1.0 / message.period_s
            frames.append(CyclicFrame(message.name, message.sender, message.length, rate_hz * max(1, len(pages))))
    return tuple(frames)


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
