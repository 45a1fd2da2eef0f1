"""Text commands over a Unix datagram socket that only the owner can open, each answered with one line.

`python -m sim.command_socket SOCKET COMMAND...` sends one: to a virtual robot run with `--inject SOCKET`.
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from sim.process import bind_private

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


def main(arguments: Sequence[str] | None = None) -> int:
    """Send one command and print its answer; return 0 if it was obeyed, 1 if not, 2 for wrong usage."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) < 2:
        print("usage: python -m sim.command_socket SOCKET COMMAND...", file=sys.stderr)
        return 2
    try:
        answer = send_command(Path(given[0]), " ".join(given[1:]))
    except OSError as error:
        print(f"{given[0]}: no answer ({error}); is the virtual robot running, with --inject?", file=sys.stderr)
        return 1
    print(answer)
    return int(answer.startswith("error"))


if __name__ == "__main__":
    raise SystemExit(main())
