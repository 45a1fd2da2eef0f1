"""One clock for everything that waits: the host's monotonic clock, or a simulated one that moves only when told."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Time in integer nanoseconds that never steps back."""

    def now_ns(self) -> int:
        """Return the present time in nanoseconds."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at the absolute time `deadline_ns` or later; at once if it has passed."""


class MonotonicClock:
    """CLOCK_MONOTONIC of this host.

    `spin_s` of busy waiting before each deadline buys a wake-up within microseconds for `spin_s` x rate of one CPU.
    """

    def __init__(self, spin_s: float = 0.0) -> None:
        if not 0.0 <= spin_s <= 0.005:
            raise ValueError(f"spin_s must be within 0 and 0.005 s, not {spin_s}")
        self._spin_ns = round(spin_s * 1e9)

    def now_ns(self) -> int:
        """Return the present time in nanoseconds."""
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at the absolute time `deadline_ns` or later; at once if it has passed."""
        while True:
            remaining_ns = deadline_ns - time.monotonic_ns()
            if remaining_ns <= 0:
                return
            if remaining_ns > self._spin_ns:
                # The remaining time is taken anew each round, so a short or interrupted sleep cannot accumulate drift.
                time.sleep((remaining_ns - self._spin_ns) * 1e-9)


class SimulatedClock:
    """A clock that stands still except when slept on or advanced."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        """Return the present simulated time in nanoseconds."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Jump to `deadline_ns`; do nothing if it has passed."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Let `duration_ns` nanoseconds pass, as work would; raises ValueError if negative."""
        if duration_ns < 0:
            raise ValueError("time does not run backwards")
        self._now_ns += duration_ns
