"""Loads drives from whatever they were recorded in."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from disco_hw.config.input_file import LOG, begin_of
from disco_hw.log.container import MAGIC
from disco_hw.log.drive import DriveLog, concatenate
from disco_hw.log.errors import LogError
from disco_hw.log.importing.csv_drive import read_csv
from disco_hw.log.mcap_drive import drive_from_log
from disco_hw.log.reader import open_log

_FEWEST_POSES = 20
_COPIED_SHARE = 0.5


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
    drives = [_load(path, ticks_per_rev, wheel_radius_m) for path in several]
    if len(drives) > 1:
        _refuse_copies(several, [_marks(drive) for drive in drives])
    return concatenate(drives)


def _refuse_copies(paths: Sequence[Path], marks: Sequence[set[tuple[float, ...]]]) -> None:
    """A log and its recovered, exported or imported copy are one drive under two names."""
    for place, path in enumerate(paths):
        for other, theirs in zip(paths[:place], marks[:place], strict=True):
            fewest = min(len(marks[place]), len(theirs))
            if fewest >= _FEWEST_POSES and len(marks[place] & theirs) > _COPIED_SHARE * fewest:
                raise LogError(f"{path}: holds what {other} holds, which would count twice; give one of them")


def _marks(drive: DriveLog) -> set[tuple[float, ...]]:
    """The different measured poses, each with the time since the one before (us), as no other drive has them."""
    poses = drive.poses
    since_us = np.rint(np.diff(poses.t_s) * 1e6)
    columns = (since_us, poses.x_m[1:], poses.y_m[1:], poses.yaw_rad[1:])
    return set(zip(*(column.tolist() for column in columns), strict=True))


def _same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _load(path: Path, ticks_per_rev: float | None, wheel_radius_m: float | None) -> DriveLog:
    if begin_of(path, LOG, len(MAGIC)) == MAGIC:
        with open_log(path) as log:
            return drive_from_log(log)
    return read_csv(path, ticks_per_rev, wheel_radius_m)
