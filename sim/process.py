"""Services of the operating system for processes of `sim`: stop signals, records that may fail, sockets, text commands.

`python -m sim.process SOCKET COMMAND...` sends one command: to a virtual robot run with `--inject SOCKET`.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TextIO

from drivers.private_files import bind_private

if TYPE_CHECKING:
    # Brings the compiler of the simulation's kernels, for which a command that is sent need not wait.
    from sim.sensors import PoseMeasurement


class StopSignal:
    """Stop request by SIGTERM or SIGINT: sets `requested` and makes `fileno()` readable; main thread only."""

    def __init__(self) -> None:
        self.requested = False
        self._wake_read, self._wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        # Without the wake-up descriptor a signal just before select() would go unnoticed until its timeout.
        signal.set_wakeup_fd(self._wake_write, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)

    def fileno(self) -> int:
        """Descriptor that becomes readable when a signal has come."""
        return self._wake_read

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True


class TextRecord:
    """Writes lines to `path`, which is emptied. Raises OSError if it cannot be opened; afterwards nothing raises.

    The first error goes to `report` in one sentence and is kept in `error`; what comes after it is not written.
    """

    def __init__(self, path: Path, report: Callable[[str], object]) -> None:
        self.error: str | None = None
        self._path = path
        self._report = report
        self._file: TextIO = path.open("w", encoding="utf-8")

    def line(self, text: str) -> None:
        """Write one line, without its end."""
        self._try(lambda: self._file.write(text + "\n"))

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        self._try(self._file.flush)

    def close(self) -> None:
        """Write what is left and close; safe to call twice."""
        self._try(self._file.close)

    def _try(self, action: Callable[[], object]) -> None:
        if self.error is not None:
            return
        try:
            action()
        except OSError as error:
            self.error = f"{self._path}: {error.strerror}; nothing more is recorded in it"
            self._report(self.error)


class PoseSender:
    """Sender of poses to one address; what cannot be sent is lost, as on a network."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, pose: PoseMeasurement, now_us: int) -> None:
        """Send a pose that is there at robot time `now_us`, with its age."""
        text = json.dumps(
            {
                "age_s": 1e-6 * (now_us - pose.sample_us),
                "x_m": pose.x_m,
                "y_m": pose.y_m,
                "yaw_rad": pose.yaw_rad,
                "position_std_m": pose.position_std_m,
                "yaw_std_rad": pose.yaw_std_rad,
            }
        )
        with contextlib.suppress(OSError):
            self._socket.sendto(text.encode(), self._address)

    def close(self) -> None:
        """Close the sender's socket."""
        self._socket.close()


# Chosen: above any line of text of commands and answers.
MAX_COMMAND_BYTES = 4096


class CommandSocket:
    """Takes commands at `path`; raises SocketPathError if it cannot."""

    def __init__(self, path: Path) -> None:
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
            # Whoever asked may be gone by now.
            with contextlib.suppress(OSError):
                self._socket.sendto(reply.encode(), sender)

    def close(self) -> None:
        """Close and remove the socket; safe to call twice."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


def send_command(path: Path, text: str) -> str:
    """Send one command to a `CommandSocket` and return its answer.

    Raises OSError if nobody listens at `path`, TimeoutError if no answer comes in time.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as client:
        # An empty name lets Linux choose an address, to which the answer can go.
        client.bind("")
        client.settimeout(5.0)
        client.sendto(text.encode(), str(path))
        return client.recv(MAX_COMMAND_BYTES).decode()


def main(arguments: Sequence[str] | None = None) -> int:
    """Send one command and print its answer; return 0 if it was obeyed, 1 if not, 2 for wrong usage."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    if len(given) < 2:
        print("usage: python -m sim.process SOCKET COMMAND...", file=sys.stderr)
        return 2
    try:
        reply = send_command(Path(given[0]), " ".join(given[1:]))
    except OSError as error:
        print(f"{given[0]}: no answer ({error}); is the virtual robot running, with --inject?", file=sys.stderr)
        return 1
    print(reply)
    return int(reply.startswith("error"))


if __name__ == "__main__":
    raise SystemExit(main())
