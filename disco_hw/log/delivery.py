"""Which ticks have reached the log's files: pure bookkeeping, every tick counted exactly once."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple


class _Parcel(NamedTuple):
    """One tick on its way: its number, how many records it has, and its frame."""

    sequence: int
    records: int
    frame: bytes


class Delivery:
    """Keeps each tick until the writer says that it is in the file; a new writer is sent again what was not.

    given = delivered + lost + waiting + dropped, in ticks. `dropped`: `most` were waiting already. `lost`: they were in
    a file that was deleted.
    """

    def __init__(self, most: int) -> None:
        self.ticks = 0
        self.records = 0
        self.dropped_ticks = 0
        self.dropped_records = 0
        self.lost_ticks = 0
        self.delivered_ticks = 0
        self.last_delivered = 0
        self._most = most
        self._waiting: deque[_Parcel] = deque()
        self._sent = 0
        self._in_file = 0

    @property
    def waiting_ticks(self) -> int:
        """Ticks that were taken and are not in a file yet."""
        return len(self._waiting)

    def put(self, sequence: int, records: int, frame: bytes) -> None:
        """Take a tick, or drop it."""
        if len(self._waiting) >= self._most:
            self.drop(records)
            return
        self.ticks += 1
        self.records += records
        self._waiting.append(_Parcel(sequence, records, frame))

    def drop(self, records: int) -> None:
        """Count a tick that is not taken."""
        self.dropped_ticks += 1
        self.dropped_records += records

    def next_frame(self) -> bytes | None:
        """The first frame that the present writer has not been sent."""
        return self._waiting[self._sent].frame if self._sent < len(self._waiting) else None

    def sent(self) -> None:
        """That frame was sent whole."""
        self._sent += 1

    def acknowledge(self, sequence: int) -> None:
        """All ticks up to this number that were sent are in the present file."""
        while self._sent and self._waiting[0].sequence <= sequence:
            self._waiting.popleft()
            self._sent -= 1
            self._in_file += 1
            self.delivered_ticks += 1
        self.last_delivered = max(self.last_delivered, sequence)

    def new_file(self) -> None:
        """Another writer begins another file: it gets what is in none."""
        self._sent = 0
        self._in_file = 0

    def file_deleted(self) -> None:
        """What was in the present file is gone."""
        self.lost_ticks += self._in_file
        self.delivered_ticks -= self._in_file
        self._in_file = 0
