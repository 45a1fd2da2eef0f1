"""What a log says about where it comes from: the software's version, and copies of the files it ran with."""

from __future__ import annotations

import subprocess
from importlib import metadata
from pathlib import Path

from disco_hw.files import FileKind, read_bytes
from disco_hw.log.link import Attachment

ROBOT_TOML = "robot.toml"
MODEL_TOML = "model.toml"
PATH_CSV = "path.csv"
DBC = "disco_robot.dbc"

_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json", ".csv": "text/csv"}


def version() -> str:
    """The package's version, with the commit when it runs from a checkout: "0.1.0+g1a2b3c4" or "...-dirty"."""
    try:
        package = metadata.version("disco-hw")
    except metadata.PackageNotFoundError:
        package = "unknown"
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return package
    describe = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        commit = subprocess.run(describe, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return package
    return f"{package}+g{commit}"


def attachment(path: Path, name: str, kind: FileKind) -> Attachment:
    """A copy of a file for the log, under a name of the log's; raises InputError if it cannot be read."""
    return Attachment(name, _MEDIA_TYPES.get(path.suffix, "text/plain"), read_bytes(path, kind)[0])
