"""Text commands over a Unix datagram socket that only the owner can open, each answered with one line."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

from sim.unix_listener import bind_private

MAX_COMMAND_BYTES = 4096


class CommandSocket:
    """Takes commands at `path`; raises SocketPathError if it cannot."""

    def __init__(self, path: Path) -> None:
        self.lost_replies = 0
        self._path = path
        self._socket = bind_private(path, socket.SOCK_DGRAM)

    def fileno(self) -> int:
        """Descriptor that is readable when a command waits."""
        return self._socket.fileno()

    def serve(self, execute: Callable[[str], str]) -> None:
        """Execute the commands that wait and send the answers back; never blocks."""
        while True:
            try:
                text, sender = self._socket.recvfrom(MAX_COMMAND_BYTES)
            except BlockingIOError:
                return
            reply = execute(text.decode("utf-8", errors="replace").strip())
            if not sender:
                continue
            try:
                self._socket.sendto(reply.encode(), sender)
            except OSError:
                self.lost_replies += 1

    def close(self) -> None:
        """Remove the socket; safe to call twice."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


def send_command(path: Path, text: str, timeout_s: float = 5.0) -> str:
    """Send one command to a `CommandSocket` and return its answer.

    Raises OSError if nobody listens at `path`, TimeoutError if no answer comes in time.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        # An empty name lets Linux choose an address, to which the answer can go.
        client.bind("")
        client.settimeout(timeout_s)
        client.sendto(text.encode(), str(path))
        return client.recv(MAX_COMMAND_BYTES).decode()
