"""Files and sockets that are their owner's alone: the key of authenticated mode, and who could put something where."""

from __future__ import annotations

import errno
import os
import pwd
import socket
import stat
from collections.abc import Collection
from pathlib import Path

from firmware_protocol.protection import parse_key

_CREATE_HINT = "make one with `(umask 077; openssl rand -hex 16 > FILE)`"
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


class KeyFileError(ValueError):
    """A key file that cannot be used; the message is one line: file, what is wrong, remedy. It never shows the key."""


def key_of_file(path: Path, content: bytes, status: os.stat_result) -> bytes:
    """Return the 16-byte AES key that a file of 32 hexadecimal digits holds; `status` is of the very file read.

    Mode and owner are then those of the content, whatever the path names a moment later. Raises KeyFileError for a
    file of another user, one that others than its owner can read, or no key.
    """
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        raise KeyFileError(f"{path}: others may read the key (mode {mode:04o}); run: chmod 600 {path}")
    if status.st_uid not in (os.geteuid(), 0):
        raise KeyFileError(f"{path}: belongs to another user; run: chown {os.geteuid()} {path}")
    try:
        return parse_key(content.decode("ascii"))
    except (ValueError, UnicodeDecodeError):
        raise KeyFileError(f"{path}: is not a key of 32 hexadecimal digits; {_CREATE_HINT}") from None


def user_name(uid: int) -> str:
    """Return a user as text: name and number."""
    try:
        return f"{pwd.getpwuid(uid).pw_name} ({uid})"
    except KeyError:
        return f"user {uid}"


def why_not_private(directory: Path, owners: Collection[int]) -> str | None:
    """Return why users other than `owners` could put something into `directory`, without its name; None if not.

    A link is refused, as whoever made it may turn it elsewhere. Raises OSError if the directory cannot be looked at.
    """
    status = directory.lstat()
    if not stat.S_ISDIR(status.st_mode):
        return f"a link or not a directory, of {user_name(status.st_uid)}"
    if status.st_uid not in owners:
        return f"belongs to {user_name(status.st_uid)}"
    if status.st_mode & _OTHERS_WRITE:
        return "others can write to it"
    return None


def placed_by(directory: Path, owners: Collection[int]) -> bool:
    """Whether nobody but `owners` could have put `directory` where it is: all directories above it are theirs alone."""
    parents = Path(os.path.realpath(directory)).parents
    return all(why_not_private(parent, owners) is None for parent in parents)


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
