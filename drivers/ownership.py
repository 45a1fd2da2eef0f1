"""Whose a directory is, and who else could put something into it."""

from __future__ import annotations

import os
import pwd
import stat
from collections.abc import Collection
from pathlib import Path

_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def user_name(uid: int) -> str:
    """A user for a person: name and number."""
    try:
        return f"{pwd.getpwuid(uid).pw_name} ({uid})"
    except KeyError:
        return f"user {uid}"


def why_not_private(directory: Path, owners: Collection[int]) -> str | None:
    """Why users other than `owners` could put something into `directory`, in words without its name; None if not.

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
