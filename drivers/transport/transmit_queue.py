"""The frames that wait for the medium, most urgent first, and never older than their deadline."""

from __future__ import annotations

import heapq

from drivers.types import OutgoingFrame


class TransmitQueue:
    """Bounded queue in the order in which a CAN bus would send: lowest identifier first, equal ones as they came.

    When it is full a more urgent frame takes the place of the least urgent one, so that an emergency stop always fits.
    """

    __slots__ = ("_capacity", "_front", "_heap", "_sequence")

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._heap: list[tuple[int, int, OutgoingFrame]] = []
        self._sequence = 0
        self._front = 0

    def __len__(self) -> int:
        return len(self._heap)

    def push(self, outgoing: OutgoingFrame) -> OutgoingFrame | None:
        """Queue a frame; return the frame that did not fit (the given or an earlier one), or None."""
        self._sequence += 1
        entry = (outgoing.frame.can_id, self._sequence, outgoing)
        if len(self._heap) < self._capacity:
            heapq.heappush(self._heap, entry)
            return None
        last = max(self._heap)
        if last < entry:
            return outgoing
        self._heap[self._heap.index(last)] = entry
        heapq.heapify(self._heap)
        return last[2]

    def pop(self) -> OutgoingFrame | None:
        """Take out the frame to send next, or None."""
        return heapq.heappop(self._heap)[2] if self._heap else None

    def put_back(self, outgoing: OutgoingFrame) -> None:
        """Return the frame taken out last: it stays the first of its identifier and counts against no limit."""
        self._front -= 1
        heapq.heappush(self._heap, (outgoing.frame.can_id, self._front, outgoing))

    def expire(self, now_ns: int) -> int:
        """Drop the frames whose deadline has passed; return how many."""
        kept = [entry for entry in self._heap if entry[2].deadline_ns >= now_ns]
        expired = len(self._heap) - len(kept)
        if expired:
            self._heap = kept
            heapq.heapify(self._heap)
        return expired

    def clear(self) -> int:
        """Drop everything; return how many frames."""
        dropped = len(self._heap)
        self._heap.clear()
        return dropped
