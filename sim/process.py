"""What processes of `sim` need of the operating system: stop signals, records that may fail, sockets and datagrams."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TextIO

from sim.sensors import PoseMeasurement


class StopSignal:
    """From its making on, SIGTERM and SIGINT set `requested` and make `fileno()` readable; main thread only."""

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


class SocketPathError(Exception):
    """The path cannot be used; the message is one line for the user."""


def bind_private(path: Path, kind: socket.SocketKind) -> socket.socket:
    """A non-blocking Unix socket of `kind` bound to `path` with file mode 0600; a stale socket file is replaced.

    A connection-oriented socket listens. Raises SocketPathError with one line that names the path and the remedy.
    """
    if path.is_symlink() or path.exists():
        _remove_stale(path, kind)
    bound = socket.socket(socket.AF_UNIX, kind)
    try:
        bound.bind(str(path))
        # Before listen() nobody can connect, so there is no moment at which others could.
        path.chmod(0o600)
        if kind is not socket.SOCK_DGRAM:
            bound.listen(64)
    except OSError as error:
        bound.close()
        raise SocketPathError(f"{path}: cannot listen here ({error.strerror or error}); choose another path") from None
    bound.setblocking(False)
    return bound


def _remove_stale(path: Path, kind: socket.SocketKind) -> None:
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise SocketPathError(f"{path}: exists and is not a socket; remove it or choose another path")
    with socket.socket(socket.AF_UNIX, kind) as probe:
        try:
            probe.connect(str(path))
        except OSError as error:
            if error.errno != errno.ECONNREFUSED:
                raise SocketPathError(f"{path}: in use ({error.strerror}); choose another path") from None
        else:
            raise SocketPathError(f"{path}: another process listens here; stop it or choose another path")
    path.unlink()


class PoseSender:
    """To one address; what cannot be sent is lost, as on a network."""

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
        """Close the socket."""
        self._socket.close()
