"""The recorder that a control loop writes to: its interface, and the recorders without a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from disco_hw.log.records import Record


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Counters since the recorder was made.

    Of the ticks given, `ticks` were taken and `dropped_ticks` were not, as too many waited. Those taken are in the
    log's files (`delivered_ticks`), not confirmed yet (`waiting_ticks`), or were in a file that was deleted
    (`lost_ticks`). `refused` records could not be encoded or decoded. `path`, `written` records and `bytes` are of the
    newest file. `fault`: why nothing is being recorded now although it should be; empty if all is well.
    """

    ticks: int = 0
    records: int = 0
    dropped_ticks: int = 0
    dropped_records: int = 0
    delivered_ticks: int = 0
    waiting_ticks: int = 0
    lost_ticks: int = 0
    refused: int = 0
    written: int = 0
    bytes: int = 0
    writer_deaths: int = 0
    writer_alive: bool = False
    path: str = ""
    fault: str = ""
    last_error: str = ""

    @property
    def missing_ticks(self) -> int:
        """Number of given ticks that are in no file."""
        return self.waiting_ticks + self.dropped_ticks + self.lost_ticks


class Recorder(Protocol):
    """Takes the records of each tick; no call but `close` waits for anything, and none raises on what it is given."""

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Record what happened in the tick at `now_ns`, in this order."""

    def poll(self) -> RecorderStats:
        """Look after the writer and return the counters; call it ten times a second."""

    def new_messages(self) -> tuple[str, ...]:
        """Return messages about the recording since the last call, for the operator."""

    def repair(self) -> None:
        """Mend what takes milliseconds; call it only while the robot is not armed."""

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """End the log, wait at most `timeout_s` for the file to be whole, and return the final counters."""


class NullRecorder:
    """Recorder that discards every record, for drives without a log."""

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Discard the records of a tick."""

    def poll(self) -> RecorderStats:
        """Return counters that are all zero."""
        return RecorderStats()

    def new_messages(self) -> tuple[str, ...]:
        """Return no messages, because nothing can happen to it."""
        return ()

    def repair(self) -> None:
        """Do nothing, because nothing of it can break."""

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """Return counters that are all zero."""
        return RecorderStats()


class MemoryRecorder:
    """Keeps every tick in `ticks` as (now_ns, records), for tests and for the harness in simulated time."""

    def __init__(self) -> None:
        self.ticks: list[tuple[int, tuple[Record, ...]]] = []

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Keep the records of a tick."""
        self.ticks.append((now_ns, tuple(records)))

    def poll(self) -> RecorderStats:
        """Counters of what was kept."""
        return RecorderStats(ticks=len(self.ticks), records=sum(len(records) for _, records in self.ticks))

    def new_messages(self) -> tuple[str, ...]:
        """Return no messages, because nothing can happen to it."""
        return ()

    def repair(self) -> None:
        """Do nothing, because nothing of it can break."""

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """Counters of what was kept."""
        return self.poll()
