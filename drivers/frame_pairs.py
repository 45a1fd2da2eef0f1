"""Joins the two frames of one sample."""

from __future__ import annotations

from firmware_protocol.codec import Decoded

LONGEST_APART_NS = 50_000_000


class FramePairs:
    """Pairs frames of two messages that carry the same counter and arrive within 50 ms of each other.

    The counter alone would not do: it is the same again after sixteen samples.
    """

    __slots__ = ("_first_name", "_waiting", "_waiting_since_ns")

    def __init__(self, first_name: str) -> None:
        self._first_name = first_name
        self._waiting: Decoded | None = None
        self._waiting_since_ns = 0

    def add(self, decoded: Decoded, received_ns: int) -> tuple[Decoded, Decoded] | None:
        """Take in a frame of either message; return both, the first message's first, when they are complete."""
        other, self._waiting = self._waiting, None
        if (
            other is None
            or other.name == decoded.name
            or other.counter != decoded.counter
            or received_ns - self._waiting_since_ns > LONGEST_APART_NS
        ):
            self._waiting, self._waiting_since_ns = decoded, received_ns
            return None
        return (decoded, other) if decoded.name == self._first_name else (other, decoded)
