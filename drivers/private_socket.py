"""Unix sockets that only their owner may connect to."""

from __future__ import annotations

import errno
import socket
import stat
from pathlib import Path


class SocketPathError(Exception):
    """The path cannot be used; the message is one line for the user."""


def bind_private(path: Path, kind: socket.SocketKind) -> socket.socket:
    """Return a non-blocking Unix socket of `kind` bound to `path` with file mode 0600; a stale socket file is replaced.

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
            raise SocketPathError(f"{path}: another process listens there; stop it first, or choose another path")
    path.unlink()
