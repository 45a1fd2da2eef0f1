"""What a command writes: whether it can, found out before the work; and as JSON that any reader takes."""

from __future__ import annotations

import json
import math
import numbers
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from disco_hw.errors import InputError


def refuse_directory(path: Path, names: Iterable[str] = (), inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if a directory cannot be made or written, or if a file of these names in it is an input."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise InputError(f"{path}: is there and is no directory; give another directory")
    _refuse_place(path)
    for name in names:
        _refuse_input(path / name, inputs)


def refuse_file(path: Path, inputs: Iterable[Path] = ()) -> None:
    """Raise InputError if a file cannot be written, or if it is one of the inputs."""
    if os.path.isdir(path):
        raise InputError(f"{path}: is a directory; give the path of a file")
    _refuse_input(path, inputs)
    _refuse_place(path)


def _refuse_input(path: Path, inputs: Iterable[Path]) -> None:
    for given in inputs:
        if path == given or (os.path.exists(path) and os.path.exists(given) and path.samefile(given)):
            raise InputError(f"{path}: would be written over, and is read here; give another path")


def _refuse_place(path: Path) -> None:
    """Refuse a path where what is there of it, from the root on, cannot be written."""
    there = path
    while not os.path.exists(there) and there != there.parent:
        there = there.parent
    if there != path and not os.path.isdir(there):
        raise InputError(f"{path}: {there} is no directory; give another path")
    if not os.access(there, os.W_OK):
        raise InputError(f"{path}: {there} cannot be written; give another path")


def as_json(result: Mapping[str, Any], indent: int | None = None) -> str:
    """One JSON object; JSON knows no infinity and no NaN, so that what is no number is null.

    Scalars and arrays of numpy are written as the numbers they are. Raises TypeError for what JSON has no word for.
    """
    return json.dumps(_plain(result), indent=indent, allow_nan=False)


def _plain(value: Any) -> Any:
    """The value in the types that `json` knows; numpy is recognised by its methods, as importing it takes long."""
    match value:
        case bool() | str() | None:
            return value
        case numbers.Integral():
            return int(value)
        case numbers.Real():
            return float(value) if math.isfinite(value) else None
        case Mapping():
            return {_plain(key): _plain(one) for key, one in value.items()}
        case list() | tuple():
            return [_plain(one) for one in value]
        case _ if hasattr(value, "tolist"):
            return _plain(value.tolist())
        case _:
            return value
