"""The CAN bus between processes: whatever connects to a Unix socket is a node."""

from __future__ import annotations

import argparse
import errno
import os
import select
import signal
import socket
import stat
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from sim.can_frame import FRAME_BYTES


class HubError(Exception):
    """The hub cannot listen; the message is one line for the user."""


@dataclass(slots=True)
class _Client:
    connection: socket.socket
    waiting: deque[bytes]


class Hub:
    """Carries each frame of a connected process to all others."""

    def __init__(self, path: Path, *, bitrate: int = 500_000, pacing: bool = True) -> None:
        self.path = path
        self._listener = _listen(path)
        self._epoll = select.epoll()
        self._epoll.register(self._listener, select.EPOLLIN)
        self._clients: dict[int, _Client] = {}

    def fileno(self) -> int:
        """Descriptor that is readable when `pump` has something to do."""
        return self._epoll.fileno()

    def next_wake_ns(self) -> int | None:
        """Monotonic time of the next due event, or None."""
        return None

    def pump(self, now_ns: int) -> None:
        """Take in and pass on what is due; never blocks."""
        for descriptor, _ in self._epoll.poll(0):
            if descriptor == self._listener.fileno():
                connection, _ = self._listener.accept()
                connection.setblocking(False)
                self._clients[connection.fileno()] = _Client(connection, deque())
                self._epoll.register(connection, select.EPOLLIN)
                continue
            client = self._clients[descriptor]
            while client.waiting:
                try:
                    client.connection.send(client.waiting[0])
                except OSError:
                    break
                client.waiting.popleft()
            if not client.waiting:
                self._epoll.modify(descriptor, select.EPOLLIN)
            for _ in range(64):
                try:
                    packet = client.connection.recv(FRAME_BYTES + 1)
                except BlockingIOError:
                    break
                except OSError:
                    packet = b""
                if not packet:
                    self._epoll.unregister(descriptor)
                    self._clients.pop(descriptor).connection.close()
                    break
                for other in self._clients.values():
                    if other is not client:
                        self._send(other, packet)

    def _send(self, client: _Client, packet: bytes) -> None:
        if not client.waiting:
            try:
                client.connection.send(packet)
                return
            except BlockingIOError:
                self._epoll.modify(client.connection, select.EPOLLIN | select.EPOLLOUT)
            except OSError:
                return
        client.waiting.append(packet)

    def close(self) -> None:
        """Close all connections and remove the socket."""
        for client in self._clients.values():
            client.connection.close()
        self._clients.clear()
        self._epoll.close()
        self._listener.close()
        self.path.unlink(missing_ok=True)


def _listen(path: Path) -> socket.socket:
    if path.exists() or path.is_symlink():
        _remove_stale(path)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        listener.bind(str(path))
        # Before listen() nobody can connect, so there is no moment at which the socket is open to others.
        path.chmod(0o600)
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise HubError(f"{path}: cannot listen here ({error.strerror or error}); choose another path") from None
    listener.setblocking(False)
    return listener


def _remove_stale(path: Path) -> None:
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise HubError(f"{path}: exists and is not a socket; choose another path")
    probe = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        probe.connect(str(path))
    except OSError as error:
        if error.errno != errno.ECONNREFUSED:
            raise HubError(f"{path}: in use ({error.strerror}); choose another path") from None
    else:
        raise HubError(f"{path}: another hub listens here; stop it or choose another path")
    finally:
        probe.close()
    path.unlink()


def main() -> int:
    """Serve a hub alone until SIGTERM or SIGINT: `python -m sim.hub PATH`."""
    parser = argparse.ArgumentParser(prog="python -m sim.hub")
    parser.add_argument("path", type=Path)
    parser.add_argument("--bitrate", type=int, default=500_000)
    parser.add_argument("--no-pacing", action="store_true")
    arguments = parser.parse_args()
    wake_read, wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wake_write)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    hub = Hub(arguments.path, bitrate=arguments.bitrate, pacing=not arguments.no_pacing)
    print(f"ready {arguments.path}", flush=True)
    while True:
        wake_ns = hub.next_wake_ns()
        timeout_s = None if wake_ns is None else max(0.0, (wake_ns - time.monotonic_ns()) * 1e-9)
        readable, _, _ = select.select((hub.fileno(), wake_read), (), (), timeout_s)
        if wake_read in readable:
            break
        hub.pump(time.monotonic_ns())
    hub.close()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
