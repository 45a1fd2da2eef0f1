"""A link inside one process, without threads or a clock: what tests and simulated time use in place of a medium."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from drivers.transport.reconnecting import RECEIVE_CAPACITY, TransportCounters
from drivers.types import LinkState, OutgoingFrame, ReceivedFrame, TransportStats

# As of a real link, so that an overflow shows in tests as it would there.
QUEUE_CAPACITY = RECEIVE_CAPACITY


class InProcessTransport:
    """One end of a pair; what one end sends the other receives at once, stamped with the sender's `now_ns`.

    Satisfies `drivers.types.Transport`. `connect_pair` makes the two ends; the link is up while both are open and it is
    plugged in.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._counters = TransportCounters()
        self._peer: InProcessTransport | None = None
        self._open = False
        self._plugged = True
        self.state = LinkState.CLOSED
        self.generation = 0
        self.last_error: str | None = None
        self._incoming: deque[ReceivedFrame] = deque()

    @property
    def stats(self) -> TransportStats:
        """A snapshot of the counters."""
        return self._counters.snapshot()

    def open(self) -> None:
        """Connect as soon as the other end is open too."""
        self._open = True
        self._settle_both()

    def close(self) -> None:
        """Disconnect this end; safe to call twice."""
        self._open = False
        self._settle_both()

    def plug(self, plugged: bool) -> None:
        """Pull the cable out or put it back in; what was under way is lost."""
        for end in (self, self._peer):
            if end is not None:
                end._plugged = plugged
        self._settle_both()

    def send(self, outgoing: OutgoingFrame, now_ns: int) -> bool:
        """Pass a frame to the other end; False (and a counter) if it expired or the link is down."""
        if outgoing.deadline_ns < now_ns:
            self._counters.add(expired=1)
            return False
        if self.state is not LinkState.UP or self._peer is None:
            self._counters.add(send_errors=1)
            return False
        self._counters.add(frames_sent=1)
        self._peer._handle(ReceivedFrame(now_ns, outgoing.frame))
        return True

    def receive(self) -> Sequence[ReceivedFrame]:
        """Return all frames received since the last call, oldest first."""
        if not self._incoming:
            return ()
        received = tuple(self._incoming)
        self._incoming.clear()
        return received

    def _handle(self, received: ReceivedFrame) -> None:
        if len(self._incoming) >= QUEUE_CAPACITY:
            self._incoming.popleft()
            self._counters.add(receive_overflow=1)
        self._incoming.append(received)
        self._counters.add(frames_received=1, bytes_received=len(received.frame.data))

    def _settle_both(self) -> None:
        for end in (self, self._peer):
            if end is not None:
                end._settle()

    def _settle(self) -> None:
        up = self._open and self._plugged and self._peer is not None and self._peer._open
        if up and self.state is not LinkState.UP:
            self.generation += 1
            self.last_error = None
            self._counters.add(reconnects=int(self.generation > 1))
        if not up:
            self._incoming.clear()
            if self.state is LinkState.UP and self._open:
                self.last_error = f"{self.name}: unplugged"
        self.state = LinkState.UP if up else LinkState.CONNECTING if self._open else LinkState.CLOSED


def connect_pair() -> tuple[InProcessTransport, InProcessTransport]:
    """Return the two ends of one link, both closed."""
    a, b = InProcessTransport("host"), InProcessTransport("robot")
    a._peer, b._peer = b, a
    return a, b
