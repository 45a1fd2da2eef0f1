"""The page's end of the daemon's feed; it connects, and connects again, whenever there is a daemon.

It connects only where no stranger can listen: in a directory as `socket_place.believed_users` asks for.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import msgspec
import zmq

from disco_hw.daemon.socket_place import believed_users
from disco_hw.errors import WorkError
from disco_hw.log.link import BatchDecoder
from disco_hw.log.records import Record

_QUEUED_BATCHES = 200


class FeedSubscriber:
    """Receives batches; `missed` counts those that did not get through, `malformed` what is none of the daemon's."""

    def __init__(self, path: Path) -> None:
        self.missed = 0
        self.malformed = 0
        self._sequence = 0
        self._decoder = BatchDecoder()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.RCVHWM, _QUEUED_BATCHES)
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
        """Disconnect; safe to call twice."""
        if not self._socket.closed:
            self._socket.close()
            self._context.term()

    def _count(self, sequence: int) -> None:
        # The numbers begin anew with a new daemon, and the first one seen depends on when the page was opened.
        if self._sequence and sequence > self._sequence:
            self.missed += sequence - self._sequence - 1
        self._sequence = sequence
