"""The file that holds the key of authenticated mode."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from firmware_protocol.authentication import parse_key

_MAKE = "make one with `(umask 077; openssl rand -hex 16 > FILE)`"
_LONGEST = 256


class KeyFileError(ValueError):
    """A key file that cannot be used; the message is one line: file, what is wrong, remedy. It never shows the key."""


def read_key_file(path: Path) -> bytes:
    """Return the 16-byte AES key from a file of 32 hexadecimal digits that its owner alone can read.

    Raises KeyFileError for a file that is absent, not a plain file, of another user, open to others, or no key.
    """
    try:
        # Mode and owner are those of the very file that is read, whatever the path names a moment later.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            _check(path, os.fstat(descriptor))
            text = os.read(descriptor, _LONGEST)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read ({error.strerror}); {_MAKE}") from None
    try:
        return parse_key(text.decode("ascii"))
    except (ValueError, UnicodeDecodeError):
        raise KeyFileError(f"{path}: is no key of 32 hexadecimal digits; {_MAKE}") from None


def _check(path: Path, status: os.stat_result) -> None:
    mode = stat.S_IMODE(status.st_mode)
    if not stat.S_ISREG(status.st_mode):
        raise KeyFileError(f"{path}: not a plain file; {_MAKE}")
    if mode & 0o077:
        raise KeyFileError(f"{path}: others may read the key (mode {mode:04o}); run: chmod 600 {path}")
    if status.st_uid not in (os.geteuid(), 0):
        raise KeyFileError(f"{path}: belongs to another user; run: chown {os.geteuid()} {path}")
