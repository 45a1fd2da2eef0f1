"""The adapter without a process, for simulated time."""

from __future__ import annotations

from collections import deque

from disco_hw.adaptation.adapter import Adapter
from disco_hw.adaptation.link import LinkStats
from disco_hw.adaptation.messages import FromAdapter, ToAdapter


class InlineLink:
    """The adapter in the same thread, for simulated time: a report is there with the tick after its samples."""

    def __init__(self, adapter: Adapter) -> None:
        self._adapter = adapter
        self._reports: deque[FromAdapter] = deque()
        self._sent = self._taken = 0

    @property
    def stats(self) -> LinkStats:
        """Counters."""
        return LinkStats(sent=self._sent, reports=self._taken, alive=True)

    def send(self, message: ToAdapter) -> None:
        """Let the adapter take the message in."""
        self._sent += 1
        report = self._adapter.take(message)
        if report is not None:
            self._reports.append(report)

    def receive(self) -> tuple[FromAdapter, ...]:
        """The reports so far."""
        found = tuple(self._reports)
        self._reports.clear()
        self._taken += len(found)
        return found

    def restart(self) -> bool:
        """It does not die."""
        return False

    def close(self) -> None:
        """Nothing is open."""
