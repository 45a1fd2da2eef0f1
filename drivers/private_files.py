"""Files that only their owner may read or write: the key of authenticated mode, and who could put something where."""

from __future__ import annotations

import os
import pwd
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
    _check(path, status)
    try:
        return parse_key(content.decode("ascii"))
    except (ValueError, UnicodeDecodeError):
        raise KeyFileError(f"{path}: is not a key of 32 hexadecimal digits; {_CREATE_HINT}") from None


def _check(path: Path, status: os.stat_result) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        raise KeyFileError(f"{path}: others may read the key (mode {mode:04o}); run: chmod 600 {path}")
    if status.st_uid not in (os.geteuid(), 0):
        raise KeyFileError(f"{path}: belongs to another user; run: chown {os.geteuid()} {path}")


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
