"""Loads drives from whatever they were recorded in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from disco_hw.log.container import MAGIC
from disco_hw.log.csv_import import read_csv
from disco_hw.log.drive import DriveLog, concatenate
from disco_hw.log.errors import LogError
from disco_hw.log.mcap_drive import drive_from_log
from disco_hw.log.reader import open_log


def load_drive(
    paths: Path | Sequence[Path], ticks_per_rev: float | None = None, wheel_radius_m: float | None = None
) -> DriveLog:
    """One log or several as one drive: our MCAP logs and CSV files, told apart by their content.

    `ticks_per_rev` and the nominal `wheel_radius_m` come from robot.toml and serve CSV files only. Raises LogError with
    one line for the first file that cannot be used, or that is there already.
    """
    several = [paths] if isinstance(paths, Path) else list(paths)
    if not several:
        raise LogError("no log given; give at least one")
    for place, path in enumerate(several):
        if any(_same(path, other) for other in several[:place]):
            raise LogError(f"{path}: given twice, and what it says would count twice; give each log once")
    return concatenate([_load(path, ticks_per_rev, wheel_radius_m) for path in several])


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _load(path: Path, ticks_per_rev: float | None, wheel_radius_m: float | None) -> DriveLog:
    try:
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
    except OSError as error:
        raise LogError(f"{path}: cannot be opened ({error.strerror}); give the path of a log") from None
    if magic == MAGIC:
        with open_log(path) as log:
            return drive_from_log(log)
    return read_csv(path, ticks_per_rev, wheel_radius_m)
