"""A drive as the CSV that `csv_import` takes, every float in the shortest form that reads back to the same bits."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from disco_hw.log.drive import Array, DriveLog, Index
from disco_hw.log.errors import LogError
from disco_hw.log.importing.csv_drive import COMMAND, POSE, SEGMENT, SPEED, TICKS, TIME

Cells = Callable[[float], list[str]]


def write_csv(drive: DriveLog, path: Path, ticks_per_rev: int | None) -> int:
    """Write one row for each time at which anything was recorded; return the number of rows.

    The command cells hold the command in force, and are empty where none is; the others are empty where there is no
    sample at that time. With `ticks_per_rev` the wheel angles are written as ticks. Raises LogError if the file exists
    or cannot be written.
    """
    wheels, poses = drive.wheels, drive.poses
    groups: list[tuple[tuple[str, ...], Cells]] = [
        (COMMAND, _in_force(drive)),
        (SPEED, _at(wheels.t_s, (wheels.left_speed_rad_s, wheels.right_speed_rad_s), repr)),
        (POSE, _at(poses.t_s, (poses.x_m, poses.y_m, poses.yaw_rad), repr)),
    ]
    if ticks_per_rev is not None and wheels.angle_measured:
        per_rad = ticks_per_rev / (2.0 * math.pi)
        ticks = (np.rint(wheels.left_angle_rad * per_rad), np.rint(wheels.right_angle_rad * per_rad))
        groups.insert(1, (TICKS, _at(wheels.t_s, ticks, lambda value: str(int(value)))))
    times, segments = _rows(drive)
    try:
        with path.open("x", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([TIME, *(name for names, _ in groups for name in names), SEGMENT])
            for t_s, segment in zip(times.tolist(), segments.tolist(), strict=True):
                writer.writerow([repr(t_s), *(cell for _, cells in groups for cell in cells(t_s)), segment])
    except FileExistsError:
        raise LogError(f"{path}: already exists; give another name") from None
    except OSError as error:
        # Half a table would pass for a whole one.
        path.unlink(missing_ok=True)
        raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
    return times.size


def _rows(drive: DriveLog) -> tuple[Array, Index]:
    """All times in order, and their segments."""
    parts = (drive.commands, drive.wheels, drive.poses)
    times, first = np.unique(np.concatenate([part.t_s for part in parts]), return_index=True)
    return times, np.concatenate([part.segment for part in parts])[first]


def _at(t_s: Array, columns: tuple[Array, ...], text: Callable[[float], str]) -> Cells:
    rows = dict(zip(t_s.tolist(), zip(*(column.tolist() for column in columns), strict=True), strict=True))
    nothing = [""] * len(columns)

    def cells(time: float) -> list[str]:
        values = rows.get(time)
        return nothing if values is None else [text(value) for value in values]

    return cells


def _in_force(drive: DriveLog) -> Cells:
    commands = drive.commands

    def cells(time: float) -> list[str]:
        at = int(np.searchsorted(commands.t_s, time, side="right")) - 1
        if at < 0 or math.isnan(commands.left_rad_s[at]):
            return ["", ""]
        return [repr(float(commands.left_rad_s[at])), repr(float(commands.right_rad_s[at]))]

    return cells
