"""Frames on a link and the media that carry them.

Time stamps are nanoseconds of the host's monotonic clock unless the name says otherwise.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import msgspec


class Frame(msgspec.Struct, frozen=True, gc=False):
    """One classic CAN data frame, `extended` with a 29-bit identifier; serial links tunnel those with 11 bits."""

    can_id: int
    data: bytes
    extended: bool = False


# CAN_EFF_MASK and CAN_EFF_FLAG of linux/can.h.
MAX_EXTENDED_ID = 0x1FFF_FFFF
_EXTENDED_FLAG = 0x8000_0000


def socketcan_id(frame: Frame) -> int:
    """Return the identifier with Linux's `can_id` flag for 29 bits, as a log keeps it beside a frame's data."""
    return frame.can_id | _EXTENDED_FLAG if frame.extended else frame.can_id


class ReceivedFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame as it came in, with the host time of its reception (from the kernel where the medium gives one)."""

    t_ns: int
    frame: Frame


class OutgoingFrame(msgspec.Struct, frozen=True, gc=False):
    """A frame to send, and the host time after which it must be dropped instead of sent late.

    `rank`: its place among those that wait, lowest first and equal ones as they came; None: its identifier, in the
    order in which a CAN bus would send. A driver whose frames must keep their order gives them one rank, below it an
    e-stop's.
    """

    frame: Frame
    deadline_ns: int
    rank: int | None = None


class LinkState(enum.Enum):
    """Whether a transport can carry frames now."""

    CLOSED = "closed"
    CONNECTING = "connecting"
    UP = "up"


@dataclass(frozen=True, slots=True)
class TransportStats:
    """Counters of one transport since it was made; nothing is dropped without being counted here."""

    frames_sent: int = 0
    frames_received: int = 0
    bytes_received: int = 0
    send_errors: int = 0
    receive_errors: int = 0
    expired: int = 0
    transmit_queue_full: int = 0
    receive_overflow: int = 0
    malformed: int = 0
    bus_errors: int = 0
    bus_off: int = 0
    reconnects: int = 0


class Transport(Protocol):
    """A medium that carries frames; it reconnects by itself with back-off and never raises on what the peer sends."""

    @property
    def name(self) -> str:
        """Medium and address, for messages to the operator."""

    @property
    def state(self) -> LinkState:
        """Whether frames can be carried now."""

    @property
    def generation(self) -> int:
        """Number of times the link has come up; a change means that everything agreed with the peer is void."""

    @property
    def stats(self) -> TransportStats:
        """A snapshot of the counters."""

    @property
    def last_error(self) -> str | None:
        """The newest error in words, or None if there was none since the link last came up."""

    def open(self) -> None:
        """Start the receive thread and the first connection attempt; return at once."""

    def send(self, outgoing: OutgoingFrame, now_ns: int) -> bool:
        """Send a frame without blocking; False (and a counter) if it expired, did not fit or the link is down."""

    def receive(self) -> Sequence[ReceivedFrame]:
        """Return all frames received since the last call, oldest first, without blocking."""

    def close(self) -> None:
        """Stop the thread and release the medium; safe to call twice."""


class Exchange(Protocol):
    """Protocol of a serial line on which one request is under way at a time, and a reply belongs to the last one.

    A frame is a packet here: `can_id` says to whom it goes and what it is. `timeout_s`: how long the device may take to
    begin; `quiet_s`: how long the line is left alone after a reply that did not come.
    """

    @property
    def timeout_s(self) -> float:
        """Longest time from the last byte of a request to the last of its reply, at infinite line speed."""

    @property
    def quiet_s(self) -> float:
        """Silence after which a device that is in the middle of a packet begins again."""

    def request(self, frame: Frame) -> bytes:
        """Return the bytes of a packet on the line."""

    def is_answered(self, frame: Frame) -> bool:
        """Whether the device replies to it."""

    def reply(self, frame: Frame, received: bytes) -> Frame | None:
        """Return the reply to `frame` that the bytes received since then begin with.

        None if it is none, or not whole yet.
        """


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """A frame of `length` data bytes that `sender` sends `rate_hz` times a second.

    `line_bytes`: all of its bytes on a serial line, and `pause_s` how long that rests after it, where the driver speaks
    a framing of its own there; None: the data and what the reference protocol's framing adds.
    """

    name: str
    sender: str
    length: int
    rate_hz: float
    line_bytes: int | None = None
    pause_s: float = 0.0
