"""Admission of connections that may stay open at the page's server before they have shown the token.

Any user of the machine can connect to the page. Without a bound, connections that send nothing take every file
descriptor of the process and every turn of its event loop.
"""

from __future__ import annotations

import logging
import math
import socket
import time
from collections.abc import Callable
from typing import Any, Protocol

from websockets.asyncio.server import ServerConnection

from disco_hw.processes import free_descriptors

REQUEST_TIMEOUT_S = 3.0
"""How long a connection may take for its request and the opening of a WebSocket."""
# Chosen: connections without a token, as a part of the free descriptors: a browser opens a few, and a flood must leave
# the others.
_MOST_UNPROVEN = 64
_LEAST_UNPROVEN = 8
_FREE_PER_UNPROVEN = 4
# Chosen: a flood must not fill the console, nor take the processor from the page.
_REPEAT_S = 1.0
_FLOOD_S = 1.0
_FLOOD_PAUSE_S = 0.002
ACCEPTED_PER_TURN = 4
"""How many connections the event loop accepts before it looks at what else has come, as an e-stop."""


class Abortable(Protocol):
    """Protocol of a transport that can be closed at once."""

    def abort(self) -> None:
        """Close without waiting for what is unsent."""


class Admission:
    """The connections that have not shown the token: `most` of them, and the oldest is closed for a newer one.

    A browser sends its request together with the connection. So the oldest that has sent none is no browser's.
    """

    def __init__(self, most: int | None = None) -> None:
        room = free_descriptors() // _FREE_PER_UNPROVEN
        self.most = min(_MOST_UNPROVEN, max(_LEAST_UNPROVEN, room)) if most is None else most
        self._closed_s = -math.inf
        self._unproven: dict[Abortable, None] = {}

    def arrive(self, transport: Abortable) -> None:
        """Take in a new connection, and close the oldest unproven one if there are too many."""
        self._unproven[transport] = None
        if len(self._unproven) > self.most:
            oldest = next(iter(self._unproven))
            del self._unproven[oldest]
            self._closed_s = time.monotonic()
            oldest.abort()

    @property
    def is_flooded(self) -> bool:
        """Whether a connection had to make room for a newer one within the last second."""
        return time.monotonic() - self._closed_s < _FLOOD_S

    def prove(self, transport: Abortable) -> None:
        """Note that a connection has shown the token: it stays."""
        self._unproven.pop(transport, None)

    # One that has ended needs no place any more.
    leave = prove


class PacedListener(socket.socket):
    """A listening socket that accepts at most 500 connections a second while the page is flooded.

    Each pause leaves the processor and the interpreter to the threads that stop the robot. Takes over `listener`.
    """

    def __init__(self, listener: socket.socket, admission: Admission) -> None:
        super().__init__(fileno=listener.detach())
        self._admission = admission

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection as `socket.accept` does, after a pause if there are too many."""
        if self._admission.is_flooded:
            time.sleep(_FLOOD_PAUSE_S)
        return super().accept()


class _CountedConnection(ServerConnection):
    """A connection of websockets that reports to the admission when it is made and when it has ended."""

    def __init__(self, admission: Admission, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._admission = admission

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._admission.arrive(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        self._admission.leave(self.transport)
        super().connection_lost(exc)


def counted_connections(admission: Admission) -> Callable[..., ServerConnection]:
    """Return a factory for `create_connection` of `websockets.asyncio.server.serve` that counts connections."""

    def create(*arguments: Any, **options: Any) -> ServerConnection:
        return _CountedConnection(admission, *arguments, **options)

    return create


class RateLimit(logging.Filter):
    """Lets each kind of message through once a second, with the count of those left out, in one line each."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[str, tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether this record is written; shortens it to a line."""
        kind = str(record.msg).partition("\n")[0]
        since_s, left_out = self._last.get(kind, (-_REPEAT_S, 0))
        if record.created - since_s < _REPEAT_S:
            self._last[kind] = since_s, left_out + 1
            return False
        self._last[kind] = record.created, 0
        cause = "" if record.exc_info is None or record.exc_info[1] is None else f": {record.exc_info[1]}"
        more = f" ({left_out} more like this)" if left_out else ""
        record.msg = f"page: {record.getMessage().partition(chr(10))[0]}{cause}{more}"
        record.args, record.exc_info = None, None
        return True
