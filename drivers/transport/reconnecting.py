"""Two threads that keep a link alive: one connects, receives and reconnects, the other sends.

The threads inherit the scheduling policy and priority of the thread that calls `open`: a daemon that wants them in real
time sets its own policy first. They are the only place where a medium may block; the control loop never does.
"""

from __future__ import annotations

import dataclasses
import heapq
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from drivers.types import MAX_EXTENDED_ID, Frame, LinkState, OutgoingFrame, ReceivedFrame, TransportStats
from firmware_protocol.serial_framing import MAX_CAN_ID, MAX_DATA

# A full bus of 1 Mbit/s carries about 8000 full frames a second: half a second in which the loop does not look. Chosen.
RECEIVE_CAPACITY = 4096
# Several ticks of commands; each frame has a deadline, and what waits longer is dropped. Chosen.
TRANSMIT_CAPACITY = 64
# A frame takes 0.1 to 0.3 ms on a bus of 500 kbit/s: by then there is room for several.
_BUSY_RETRY_S = 0.001
# What a VESC takes in one packet.
_MOST_PACKET = 512
# A closing link sends what waits, such as a stop, and does not hang where the medium does. Chosen.
_DRAIN_S = 0.1
_JOIN_S = 1.0
# A mute link is opened anew after this, then after twice its silence, up to the longest: a robot may just be switched
# off. Chosen.
MUTE_AFTER_S = 4.0
_MOST_PATIENT_S = 30.0


@dataclass(frozen=True, slots=True)
class BackoffPolicy:
    """Delays that double from `first_s` to `longest_s`; a link that was up for `steady_s` starts afresh."""

    first_s: float = 0.05
    longest_s: float = 2.0
    steady_s: float = 1.0


DEFAULT_BACKOFF = BackoffPolicy()


def next_delay_s(policy: BackoffPolicy, previous_s: float | None, up_for_s: float) -> float:
    """Return the delay before the next attempt, in seconds.

    `previous_s` is the delay before the attempt that has just failed, None if there was none; `up_for_s` how long the
    link was up after it (0 if it never came up). A link that flaps keeps backing off.
    """
    if previous_s is None or up_for_s >= policy.steady_s:
        return policy.first_s
    return min(2.0 * previous_s, policy.longest_s)


class TransmitQueue:
    """Bounded queue in the order of ranks, which are identifiers where a frame has none: as a CAN bus would send.

    Lowest first, equal ones as they came.

    When it is full a more urgent frame takes the place of the least urgent one, so that an emergency stop always fits.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._heap: list[tuple[int, int, OutgoingFrame]] = []
        self._sequence = 0
        self._front = 0

    def __len__(self) -> int:
        return len(self._heap)

    def push(self, outgoing: OutgoingFrame) -> OutgoingFrame | None:
        """Add a frame to the queue; return the frame that did not fit (the given or an earlier one), or None."""
        self._sequence += 1
        entry = (_rank(outgoing), self._sequence, outgoing)
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

    def requeue(self, outgoing: OutgoingFrame) -> None:
        """Return the frame taken out last: it stays the first of its identifier and counts against no limit."""
        self._front -= 1
        heapq.heappush(self._heap, (_rank(outgoing), self._front, outgoing))

    def expire(self, now_ns: int) -> int:
        """Drop the frames whose deadline has passed; return how many."""
        kept = [entry for entry in self._heap if entry[2].deadline_ns >= now_ns]
        expired = len(self._heap) - len(kept)
        if expired:
            self._heap = kept
            heapq.heapify(self._heap)
        return expired

    def clear(self) -> int:
        """Drop all queued frames; return how many there were."""
        dropped = len(self._heap)
        self._heap.clear()
        return dropped


def _rank(outgoing: OutgoingFrame) -> int:
    return outgoing.frame.can_id if outgoing.rank is None else outgoing.rank


class TransportCounters:
    """The counters of one transport, named as the fields of `TransportStats`."""

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


class TransmitBusyError(Exception):
    """The medium did not take a frame in time; the frame may be tried again.

    On a host that pauses in the middle of a write it may then be sent twice: pyserial looks at its clock last.
    """


class LinkLostError(Exception):
    """The medium said that it is gone; the message is for the operator."""


class LinkMuteError(LinkLostError):
    """The medium is open and nothing comes from it."""


class TransportSettingsError(ValueError):
    """Settings of a link that no device could satisfy; the message is one line: field, what is wrong, what to write."""


class Connection(Protocol):
    """A medium that is connected. One thread reads while another writes; errors mean that the link is lost."""

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait about 0.1 s at most for frames; raises anything when the link is lost."""

    def write(self, frame: Frame) -> None:
        """Send one frame in bounded time; raises TransmitBusyError if there is no room, anything else if lost."""

    def close(self) -> None:
        """Release the connected medium; may raise."""


class Medium(Protocol):
    """Medium of one kind with one address, which can be connected."""

    @property
    def name(self) -> str:
        """Medium and address, for messages to the operator."""

    def connect(self, counters: TransportCounters) -> Connection:
        """Connect in bounded time, counting malformed input and bus errors in `counters`; raises if it cannot."""

    def explain(self, error: Exception) -> str:
        """Say in one line what the error means and what to do."""


class ReconnectingTransport:
    """A `drivers.types.Transport` over any medium, which it connects again with back-off whenever it is lost.

    Whatever waits to be sent when the link is lost is dropped: nothing old is ever sent on a new link. A frame leaves
    in the order of `TransmitQueue`, and is dropped when its deadline has passed or when it does not fit the queue. That
    a link was mute, and so was connected again, stays its `last_error` until a frame comes.
    """

    def __init__(
        self,
        medium: Medium,
        *,
        backoff: BackoffPolicy = DEFAULT_BACKOFF,
        mute_after_s: float | None = None,
        carries_extended: bool = False,
        carries_packets: bool = False,
    ) -> None:
        """Create a transport that is closed.

        `mute_after_s`: a link on which no frame comes for so long is closed and connected again; None: never.

        `carries_extended`: whether the medium has frames with 29-bit identifiers; `carries_packets`: whether it has
        none, but packets of up to 512 bytes.
        """
        self._medium = medium
        self.name = medium.name
        self._largest = (
            MAX_EXTENDED_ID if carries_packets else MAX_CAN_ID,
            MAX_EXTENDED_ID if carries_extended or carries_packets else -1,
        )
        self._most_data = _MOST_PACKET if carries_packets else MAX_DATA
        self._backoff = backoff
        self._mute_after_s = mute_after_s
        self._patience_s = mute_after_s
        self._mute_reason: str | None = None
        self._counters = TransportCounters()
        self._changed = threading.Condition()
        self._writing = threading.Lock()
        self.state = LinkState.CLOSED
        self.generation = 0
        self.last_error: str | None = None
        self._connection: Connection | None = None
        self._outgoing = TransmitQueue(TRANSMIT_CAPACITY)
        self._sending = False
        self._incoming: deque[ReceivedFrame] = deque()
        self._stop = threading.Event()
        self._lost = threading.Event()
        self._threads: tuple[threading.Thread, ...] = ()

    @property
    def stats(self) -> TransportStats:
        """A snapshot of the counters."""
        return self._counters.snapshot()

    def open(self) -> None:
        """Start both threads and the first connection attempt; return at once.

        Does nothing the second time; a closed transport stays closed.
        """
        if self._threads or self._stop.is_set():
            return
        self.state = LinkState.CONNECTING
        self._threads = (
            threading.Thread(target=self._run_receiver, name=f"{self.name} receive", daemon=True),
            threading.Thread(target=self._run_sender, name=f"{self.name} send", daemon=True),
        )
        for thread in self._threads:
            thread.start()

    def send(self, outgoing: OutgoingFrame, now_ns: int) -> bool:
        """Hand a frame to the sending thread; False (and a counter) if it expired, did not fit or the link is down.

        Raises ValueError for what is no classic CAN frame, or none that this medium has.
        """
        largest = self._largest[outgoing.frame.extended]
        if not 0 <= outgoing.frame.can_id <= largest or len(outgoing.frame.data) > self._most_data:
            raise ValueError(f"not a classic CAN frame: {outgoing.frame}")
        if outgoing.deadline_ns < now_ns:
            self._counters.add(expired=1)
            return False
        with self._changed:
            if self.state is not LinkState.UP:
                self._counters.add(send_errors=1)
                return False
            dropped = self._outgoing.push(outgoing)
            self._changed.notify_all()
        if dropped is not None:
            self._counters.add(transmit_queue_full=1)
        return dropped is not outgoing

    def receive(self) -> Sequence[ReceivedFrame]:
        """Return all frames received since the last call, oldest first, without blocking."""
        with self._changed:
            received = tuple(self._incoming)
            self._incoming.clear()
        return received

    def close(self) -> None:
        """Send what is queued (for 0.1 s at most), stop the threads and release the medium; safe to call twice."""
        with self._changed:
            self._changed.wait_for(lambda: self._connection is None or self._all_sent(), timeout=_DRAIN_S)
            self._stop.set()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(_JOIN_S)
        self._threads = ()
        self.state = LinkState.CLOSED

    def _run_receiver(self) -> None:
        delay_s: float | None = None
        while not self._stop.is_set():
            up_for_s = 0.0
            try:
                connection = self._medium.connect(self._counters)
            except Exception as error:  # whatever a backend raises, this thread must outlive it
                self._note(error)
            else:
                came_up_ns = time.monotonic_ns()
                self._come_up(connection)
                self._pump(connection)
                self._go_down(connection)
                up_for_s = (time.monotonic_ns() - came_up_ns) * 1e-9
            delay_s = next_delay_s(self._backoff, delay_s, up_for_s)
            self._stop.wait(delay_s)

    def _pump(self, connection: Connection) -> None:
        received_ns = time.monotonic_ns()
        while not (self._stop.is_set() or self._lost.is_set()):
            try:
                frames = connection.read()
                if not frames:
                    self._refuse_silence(received_ns)
            except Exception as error:  # whatever a backend raises, this thread must outlive it
                self._counters.add(receive_errors=1)
                self._note(error)
                self._mute_reason = self.last_error if isinstance(error, LinkMuteError) else None
                return
            if frames:
                received_ns = time.monotonic_ns()
                self._deliver(frames)

    def _refuse_silence(self, received_ns: int) -> None:
        """Raise LinkMuteError when nothing has come for too long, and be twice as patient the next time.

        An adapter that comes back under another name can leave an open port behind that says nothing and never fails.
        """
        if self._patience_s is not None and time.monotonic_ns() - received_ns > self._patience_s * 1e9:
            silent_s = self._patience_s
            self._patience_s = min(2.0 * silent_s, _MOST_PATIENT_S)
            raise LinkMuteError(f"open, but no frame received for {silent_s:g} s")

    def _deliver(self, frames: Sequence[ReceivedFrame]) -> None:
        if self._mute_reason is not None:
            self.last_error = self._mute_reason = None
        self._patience_s = self._mute_after_s
        with self._changed:
            self._incoming.extend(frames)
            overflow = max(0, len(self._incoming) - RECEIVE_CAPACITY)
            for _ in range(overflow):
                # A reader that has fallen behind is served better by what is true now.
                self._incoming.popleft()
        self._counters.add(
            frames_received=len(frames),
            bytes_received=sum(len(received.frame.data) for received in frames),
            receive_overflow=overflow,
        )

    def _come_up(self, connection: Connection) -> None:
        with self._changed:
            self._lost.clear()
            self._incoming.clear()
            self._connection = connection
            # That it was mute is worth saying until it is not.
            self.last_error = self._mute_reason
            # Counted before it shows, so that nobody sees a link that came back and was not counted.
            self._counters.add(reconnects=1 if self.generation else 0)
            self.generation += 1
            self.state = LinkState.UP
            self._changed.notify_all()

    def _go_down(self, connection: Connection) -> None:
        with self._changed:
            self.state = LinkState.CONNECTING
            self._connection = None
            dropped = self._outgoing.clear()
            self._changed.notify_all()
        self._counters.add(send_errors=dropped)
        with self._writing:
            try:
                connection.close()
            except Exception as error:  # a device that is gone cannot be closed properly either
                if self.last_error is None:
                    self._note(error)

    def _run_sender(self) -> None:
        refused: OutgoingFrame | None = None
        while not self._stop.is_set():
            with self._changed:
                self._changed.wait_for(lambda: self._stop.is_set() or self._ready_to_send())
                connection = self._connection
                self._counters.add(expired=self._outgoing.expire(time.monotonic_ns()))
                outgoing = self._outgoing.pop() if connection is not None else None
                self._sending = outgoing is not None
            if connection is None or outgoing is None:
                continue
            done = self._write(connection, outgoing)
            with self._changed:
                if not done and self._connection is connection:
                    self._outgoing.requeue(outgoing)
                self._sending = False
                self._changed.notify_all()
            if not done:
                if refused is not outgoing:
                    refused = outgoing
                    self._counters.add(transmit_queue_full=1)
                self._stop.wait(_BUSY_RETRY_S)

    def _all_sent(self) -> bool:
        return not self._sending and len(self._outgoing) == 0

    def _ready_to_send(self) -> bool:
        return self._connection is not None and not self._lost.is_set() and len(self._outgoing) > 0

    def _write(self, connection: Connection, outgoing: OutgoingFrame) -> bool:
        """Write one frame to the medium; False if there was no room for it now."""
        with self._writing:
            try:
                if self._connection is not connection:
                    raise LinkLostError("the link went down before the frame was sent")
                connection.write(outgoing.frame)
            except TransmitBusyError as error:
                self._note(error)
                return False
            except Exception as error:  # whatever a backend raises, this thread must outlive it
                self._counters.add(send_errors=1)
                if self._connection is connection:
                    self._note(error)
                    self._lost.set()
                return True
        self._counters.add(frames_sent=1)
        return True

    def _note(self, error: Exception) -> None:
        self.last_error = self._medium.explain(error)
