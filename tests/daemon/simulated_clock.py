"""A clock for loops and waits that takes no time."""


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
        """Let `duration_ns` nanoseconds pass, as work would."""
        self._now_ns += duration_ns
