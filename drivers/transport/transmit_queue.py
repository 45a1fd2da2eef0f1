"""The frames that wait for the medium, most urgent first, and never older than their deadline."""

from __future__ import annotations

import heapq

from drivers.types import OutgoingFrame


class TransmitQueue:
    """Bounded queue in the order in which a CAN bus would send: lowest identifier first, equal ones as they came.

    When it is full a more urgent frame takes the place of the least urgent one, so that an emergency stop always fits.
    """

    __slots__ = ("_capacity", "_heap", "_sequence")

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._heap: list[tuple[int, int, OutgoingFrame]] = []
        self._sequence = 0

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

    def peek(self) -> OutgoingFrame | None:
        """Return the frame to send next without taking it out, or None."""
        return self._heap[0][2] if self._heap else None

    def remove(self, outgoing: OutgoingFrame) -> None:
        """Take out this frame object, wherever it is now; nothing happens if it is gone."""
        for index, (_, _, queued) in enumerate(self._heap):
            if queued is outgoing:
                del self._heap[index]
                heapq.heapify(self._heap)
                return

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
