"""A connection to the daemon's control socket, opened beforehand and kept for requests that must get through."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from disco_hw.daemon import HungUpError, connect, errors_in_one_line, exchange
from disco_hw.errors import WorkError

# Chosen: a local socket that takes longer has no daemon that listens.
_CONNECT_S = 0.2


class KeptConnection:
    """One open connection to the daemon at `path`: a request on it needs no new file descriptor.

    `ensure_connected` opens it, and again after the daemon was restarted; call it a few times a second. Safe to use
    from several threads.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._connection: socket.socket | None = None

    def ensure_connected(self) -> None:
        """Connect if there is no open connection; does nothing without a daemon or while a request is under way."""
        if not self._lock.acquire(blocking=False):
            return
        try:
            if not self._is_open():
                self._drop()
                with contextlib.suppress(OSError, WorkError):
                    self._connection = connect(self._path, _CONNECT_S)
        finally:
            self._lock.release()

    def request(self, request: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send one request and return the reply; a daemon that has hung up is asked once more on a new connection.

        For requests that may arrive twice. Raises WorkError in one line as `send_request` does.
        """
        deadline_s = time.monotonic() + timeout_s
        with errors_in_one_line(self._path, timeout_s):
            if not self._lock.acquire(timeout=timeout_s):
                raise TimeoutError
            try:
                return self._exchange(request, deadline_s, timeout_s)
            except BaseException:
                # A reply that comes too late must not be taken for that of the next request.
                self._drop()
                raise
            finally:
                self._lock.release()

    def close(self) -> None:
        """Close the connection to the daemon; safe to call twice."""
        with self._lock:
            self._drop()

    def _exchange(self, request: Mapping[str, Any], deadline_s: float, timeout_s: float) -> dict[str, Any]:
        if self._is_open():
            assert self._connection is not None
            try:
                return exchange(self._connection, self._path, request, deadline_s)
            except (ConnectionError, HungUpError):
                pass
        self._drop()
        self._connection = connect(self._path, timeout_s)
        return exchange(self._connection, self._path, request, deadline_s)

    def _is_open(self) -> bool:
        """Whether there is a connection on which the daemon has neither hung up nor left anything unread."""
        if self._connection is None:
            return False
        # With a timeout set Python itself waits, whatever the flags say.
        self._connection.settimeout(0.0)
        try:
            self._connection.recv(1, socket.MSG_PEEK)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return False

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
