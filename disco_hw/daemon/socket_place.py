"""Where the daemon's control socket is, and whom to believe there: one rule for the daemon and for who asks it."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import struct
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from disco_hw.errors import WorkError
from drivers.private_files import placed_by, user_name, why_not_private

REMEDY = "set daemon.control_socket to a path in a directory of your own"
_ROOT = 0
_TEMPORARY = Path("/tmp")


def default_socket_path(name: str) -> Path:
    """Return where the socket of the robot called `name` is, in a directory that only this user can enter.

    $XDG_RUNTIME_DIR/disco-hw/NAME.sock, or where that variable names no directory of this user the first of
    /tmp/disco-hw-UID, /tmp/disco-hw-UID-2, -3, ... that is this user's, or else the first that is not there yet. What
    other users made there is passed over, and cannot change the choice once this user's directory exists. Root is
    given the socket in another user's XDG_RUNTIME_DIR if there is one.
    """
    uid = os.geteuid()
    file_name = re.sub(r"[^A-Za-z0-9_-]", "_", name) + ".sock"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        directory = Path(runtime) / "disco-hw"
        if _is_own(Path(runtime), uid) and (_is_own(directory, uid) or not _exists(directory)):
            return directory / file_name
        if uid == _ROOT and (directory / file_name).is_socket():
            return directory / file_name
    own = next((directory for directory in _taken(uid) if _is_own(directory, uid)), None)
    return (own or next(directory for directory in _names(uid) if not _exists(directory))) / file_name


def passed_over(path: Path) -> tuple[str, ...]:
    """The directories that `default_socket_path` did not believe before it came to `path`: a line each, with owners."""
    uid = os.geteuid()
    if path.parent.parent != _TEMPORARY or not _numbered(uid).fullmatch(path.parent.name):
        return ()
    candidates = _taken(uid)
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        candidates = [Path(runtime), Path(runtime) / "disco-hw", *candidates]
    lines = []
    for directory in candidates:
        with contextlib.suppress(OSError):
            if (why := why_not_private(directory, {uid})) is not None:
                lines.append(f"{directory}: {why}; passed over")
    return tuple(lines)


def believed_users(path: Path) -> frozenset[int]:
    """Return the users whose daemon may listen at `path`: this one, root, and for root whose directory it is.

    Root believes another user only in a directory that no third one can have put there. Raises WorkError, naming the
    owner, if the directory is a stranger's or others can write to it, and OSError if it cannot be looked at.
    """
    directory, uid = path.parent, os.geteuid()
    believed = frozenset({uid, _ROOT})
    why = why_not_private(directory, believed)
    if why is not None and uid == _ROOT:
        owner = directory.lstat().st_uid
        if why_not_private(directory, {owner}) is None and placed_by(directory, {owner, _ROOT}):
            return believed | {owner}
    if why is not None:
        raise WorkError(f"{directory}: {why}; nothing is sent there, {REMEDY}")
    return believed


def connect(path: Path, timeout_s: float) -> socket.socket:
    """Return a connection to the daemon at `path`, whose user is one of `believed_users`.

    Raises WorkError if it is another user's process, and OSError if nobody listens.
    """
    believed = believed_users(path)
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(timeout_s)
        connection.connect(str(path))
        listener = peer_uid(connection)
        if listener not in believed:
            raise WorkError(f"{path}: a process of {user_name(listener)} listens there; nothing is sent, {REMEDY}")
    except BaseException:
        connection.close()
        raise
    return connection


def peer_uid(connection: socket.socket) -> int:
    """The user whose process has the other end of a Unix socket."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return int(struct.unpack("3i", credentials)[1])


def _names(uid: int) -> Iterator[Path]:
    yield _TEMPORARY / f"disco-hw-{uid}"
    for number in count(2):
        yield _TEMPORARY / f"disco-hw-{uid}-{number}"


def _numbered(uid: int) -> re.Pattern[str]:
    return re.compile(rf"disco-hw-{uid}(?:-([2-9]|[1-9][0-9]{{1,6}}))?")


def _taken(uid: int) -> list[Path]:
    """What is there under one of the names in /tmp, in their order."""
    numbered = _numbered(uid)
    found = [(int(match[1] or 1), entry) for entry in os.listdir(_TEMPORARY) if (match := numbered.fullmatch(entry))]
    return [_TEMPORARY / entry for _, entry in sorted(found)]


def _is_own(directory: Path, uid: int) -> bool:
    try:
        return why_not_private(directory, {uid}) is None
    except OSError:
        return False


def _exists(directory: Path) -> bool:
    return os.path.lexists(directory)
