"""The file that holds the key of authenticated mode."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from firmware_protocol.authentication import parse_key

_MAKE = "make one with `(umask 077; openssl rand -hex 16 > FILE)`"


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
        raise KeyFileError(f"{path}: is no key of 32 hexadecimal digits; {_MAKE}") from None


def _check(path: Path, status: os.stat_result) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if mode & 0o077:
        raise KeyFileError(f"{path}: others may read the key (mode {mode:04o}); run: chmod 600 {path}")
    if status.st_uid not in (os.geteuid(), 0):
        raise KeyFileError(f"{path}: belongs to another user; run: chown {os.geteuid()} {path}")
