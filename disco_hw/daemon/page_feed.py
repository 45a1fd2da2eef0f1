"""The feed of the page and the bridges: publishes what is recorded, and never waits for who looks.

Nobody looking costs one non-blocking receive a batch. Who does not keep up misses batches, sees that by their numbers,
and holds up neither the loop nor the other pages.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path

import msgspec
import zmq

from disco_hw.daemon import believed_users
from disco_hw.errors import InputError, WorkError
from disco_hw.log import ENCODE_ERRORS, BatchDecoder, batch_encoder
from disco_hw.log.recorder import Recorder, RecorderStats
from disco_hw.log.records import FrameIn, FrameOut, Plan, Record
from drivers.types import WheelSample

# Chosen: 25 pictures a second look smooth; a shorter period takes more of the processor.
PERIOD_S = 0.04
# Batches of PERIOD_S: 1.6 s at this end and 8 s at the reader's, after which a slow reader loses some.
_QUEUED_BATCHES = 40
_UNREAD_BATCHES = 200
# Chosen: above what a period brings; further ones are dropped, oldest first, so that no reader fills the memory.
_MOST_RECORDS = 400


def feed_path(control_socket: Path) -> Path:
    """Return the path of the page's feed, in the private directory of this control socket."""
    return control_socket.with_name(control_socket.name + ".view")


def tick_feed_path(control_socket: Path) -> Path:
    """Return the path of the feed for bridges, which publishes each tick at once."""
    return control_socket.with_name(control_socket.name + ".tick")


class ViewerFeed:
    """Publishes batches of records at `path` every `period_s` while somebody is connected.

    Frames are left out, and of the plans of one batch all but the newest. Raises InputError if the socket cannot be
    made; nothing else raises. The directory must be its owner's alone.
    """

    def __init__(self, path: Path, period_s: float = PERIOD_S) -> None:
        self.sent = 0
        self.refused = 0
        self._path = path
        self._period_ns = round(period_s * 1e9)
        self._encode = batch_encoder()
        self._pending: list[Record] = []
        self._plan: Plan | None = None
        self._next_ns = 0
        self.watched = False
        """Whether somebody is connected."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, _QUEUED_BATCHES)
        self._socket.setsockopt(zmq.LINGER, 0)
        mask = os.umask(0o177)
        try:
            self._socket.bind(f"ipc://{path}")
        except zmq.ZMQError as error:
            self._socket.close()
            self._context.term()
            raise InputError(
                f"{path}: the page's socket cannot be created ({error.strerror}); shorten daemon.control_socket"
            ) from None
        finally:
            os.umask(mask)

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Take the records of one tick, and publish what has gathered if it is time."""
        if self.watched:
            self._gather(records)
        if now_ns < self._next_ns:
            return
        # On a grid: a period counted from this tick would grow to the next whole tick, every time.
        self._next_ns = max(self._next_ns + self._period_ns, now_ns)
        self._notice_watchers()
        if self.watched and (self._pending or self._plan is not None):
            self._publish(now_ns)

    def restore(self) -> None:
        """Make the socket again where its file was removed; who was connected stays so."""
        # That of Path raises where this user may not look.
        if os.path.exists(self._path):
            return
        mask = os.umask(0o177)
        try:
            self._socket.bind(f"ipc://{self._path}")
        except zmq.ZMQError:
            # Its directory is gone again; the next restoration of the control socket brings another try.
            self.refused += 1
        finally:
            os.umask(mask)

    def close(self) -> None:
        """Disconnect everybody and remove the socket; safe to call twice."""
        if not self._socket.closed:
            self._socket.close()
            self._context.term()
            self._path.unlink(missing_ok=True)

    def _gather(self, records: Sequence[Record]) -> None:
        for record in records:
            if type(record) is Plan:
                self._plan = record
            elif type(record) is not FrameIn and type(record) is not FrameOut:
                self._pending.append(record)
        if len(self._pending) > _MOST_RECORDS:
            self.refused += len(self._pending) - _MOST_RECORDS
            del self._pending[:-_MOST_RECORDS]

    def _notice_watchers(self) -> None:
        """Update whether a page watches: the socket reports when a first one subscribes and the last one leaves."""
        with contextlib.suppress(zmq.Again):
            while True:
                self.watched = self._socket.recv(zmq.NOBLOCK)[:1] == b"\x01"

    def _publish(self, now_ns: int) -> None:
        batch = self._pending if self._plan is None else [*self._pending, self._plan]
        self._pending, self._plan = [], None
        try:
            self._socket.send(self._encode(self.sent + 1, now_ns, batch), zmq.NOBLOCK)
        except (*ENCODE_ERRORS, zmq.ZMQError):
            self.refused += len(batch)
        else:
            self.sent += 1


class WatchedRecorder:
    """A recorder whose records go to the page as well, and to who wants each tick."""

    def __init__(self, recorder: Recorder, feed: ViewerFeed, ticks: ViewerFeed) -> None:
        self._recorder = recorder
        self._feed = feed
        self._ticks = ticks

    @property
    def watched(self) -> bool:
        """Whether a page reads the feed."""
        return self._feed.watched

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Record the tick, then show it."""
        self._recorder.put(now_ns, records)
        self._feed.put(now_ns, records)
        self._ticks.put(now_ns, records)

    def announce(self, now_ns: int, wheels: Sequence[WheelSample]) -> None:
        """Show who wants each tick the wheels of one that is yet to be planned; `put` brings them again."""
        self._ticks.put(now_ns, wheels)

    def restore_feeds(self) -> None:
        """Make the feeds' sockets again where they were removed."""
        self._feed.restore()
        self._ticks.restore()

    def poll(self) -> RecorderStats:
        """Return the counters of the recorder."""
        return self._recorder.poll()

    def new_messages(self) -> tuple[str, ...]:
        """Return the news of the recorder."""
        return self._recorder.new_messages()

    def repair(self) -> None:
        """Let the recorder repair what takes milliseconds."""
        self._recorder.repair()

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """Close the log and return its counters; the feeds are closed by their owner."""
        return self._recorder.close(timeout_s)


class FeedSubscriber:
    """Receiver of a feed's batches; `missed` counts lost ones, `malformed` those that are none of the daemon's."""

    def __init__(self, path: Path) -> None:
        self.missed = 0
        self.malformed = 0
        self._sequence = 0
        self._decoder = BatchDecoder()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, _UNREAD_BATCHES)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 100)
        self._socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
        self._socket.setsockopt(zmq.SUBSCRIBE, b"")
        self._path = path
        self._connected = False

    def receive(self, timeout_s: float) -> list[tuple[int, Record]]:
        """Wait at most `timeout_s` for a batch; then everything that is there as (tick's time, record)."""
        received: list[tuple[int, Record]] = []
        self._connect()
        if not self._socket.poll(round(timeout_s * 1e3)):
            return received
        while True:
            try:
                message = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return received
            try:
                batch = self._decoder.batch(message)
                records = [self._decoder.record(topic, data) for topic, data in batch.records]
            except msgspec.MsgspecError:
                self.malformed += 1
                continue
            self._count(batch.sequence)
            received += [(batch.now_ns, record) for record in records]

    def _connect(self) -> None:
        if self._connected:
            return
        # Without a daemon there may be no directory yet; the page says what is wrong with another's.
        with contextlib.suppress(OSError, WorkError):
            believed_users(self._path)
            self._socket.connect(f"ipc://{self._path}")
            self._connected = True

    def close(self) -> None:
        """Disconnect from the feed; safe to call twice."""
        if not self._socket.closed:
            self._socket.close()
            self._context.term()

    def _count(self, sequence: int) -> None:
        # The numbers begin anew with a new daemon, and the first one seen depends on when the page was opened.
        if self._sequence and sequence > self._sequence:
            self.missed += sequence - self._sequence - 1
        self._sequence = sequence
