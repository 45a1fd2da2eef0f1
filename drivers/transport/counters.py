"""Counters that several threads add to."""

from __future__ import annotations

import dataclasses
import threading

from drivers.types import TransportStats


class Counters:
    """The counters of one transport, named as the fields of `TransportStats`."""

    __slots__ = ("_counts", "_lock")

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = {field.name: 0 for field in dataclasses.fields(TransportStats)}

    def add(self, **increments: int) -> None:
        """Add to counters by name. Raises KeyError for a name that `TransportStats` does not have."""
        with self._lock:
            for name, increment in increments.items():
                self._counts[name] += increment

    def snapshot(self) -> TransportStats:
        """Return all counters as of one instant."""
        with self._lock:
            return TransportStats(**self._counts)
