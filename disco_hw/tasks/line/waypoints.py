"""Way-points from a CSV: places to pass, in order, with or without the times to be there."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from disco_hw.errors import InputError
from disco_hw.files import WAY_POINTS, read_lines
from disco_hw.tasks.task import FARTHEST_M, Array, Point

LEAST_DISTANCE_M = 1e-6
SHORTEST_M = 0.1
LONGEST_M = 2000.0
MOST_POINTS = 10_000


@dataclass(frozen=True, eq=False, slots=True)
class Waypoints:
    """Places (N, 2) in the world frame (m) and times (N,) from the start (s), or None.

    `lines`: where in their file they are, if they are from one.
    """

    places_m: Array
    times_s: Array | None = None
    lines: tuple[int, ...] = ()


def load_waypoints(path: Path) -> Waypoints:
    """Read a CSV with columns x_m, y_m and perhaps t_s, by name, in any order; other columns are ignored.

    Raises InputError with one line naming file, place and remedy: a file that cannot be read, a missing column, a cell
    that is not a finite number, fewer than two way-points, one repeated, times that do not increase.
    """
    lines, columns = _columns(path)
    places = np.column_stack([columns["x_m"], columns["y_m"]])
    times = columns.get("t_s")
    if times is None:
        apart = np.hypot(*np.diff(places, axis=0).T)
        if np.any(apart < LEAST_DISTANCE_M):
            line = lines[int(np.argmax(apart < LEAST_DISTANCE_M)) + 1]
            raise InputError(f"{path}: line {line}: the same way-point again; remove it, or give times in t_s")
    elif np.any(np.diff(times) <= 0.0):
        line = lines[int(np.argmax(np.diff(times) <= 0.0)) + 1]
        raise InputError(f"{path}: line {line}: t_s does not increase; sort the way-points by time")
    return Waypoints(places, times, tuple(lines))


def _columns(path: Path) -> tuple[list[int], dict[str, Array]]:
    """The lines of the rows, and the columns that there are of x_m, y_m and t_s."""
    reader = csv.reader(read_lines(path, WAY_POINTS), skipinitialspace=True)
    lines: list[int] = []
    try:
        header = next(reader, [])
        for name in ("x_m", "y_m"):
            if name not in header:
                raise InputError(
                    f"{path}: line 1: column {name}: missing; name x_m and y_m there, with a comma between"
                )
        places = {name: header.index(name) for name in ("x_m", "y_m", "t_s") if name in header}
        columns: dict[str, list[float]] = {name: [] for name in places}
        for row in reader:
            if not row:
                continue
            if len(lines) == MOST_POINTS:
                raise InputError(f"{path}: over {MOST_POINTS} way-points; write at most {MOST_POINTS}")
            lines.append(reader.line_num)
            for name, place in places.items():
                columns[name].append(_number(path, reader.line_num, name, row[place] if place < len(row) else None))
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}); give the path of a CSV of way-points") from None
    if len(lines) < 2:
        raise InputError(f"{path}: {len(lines)} way-points; write at least two")
    return lines, {name: np.array(column) for name, column in columns.items()}


def check_size(path: Path, found: Waypoints) -> None:
    """Raise InputError for a shorter or longer path, and places further off, than can be followed."""
    length_m = float(np.hypot(*np.diff(found.places_m, axis=0).T).sum())
    if not SHORTEST_M <= length_m <= LONGEST_M:
        raise InputError(f"{path}: {length_m:g} m long; between {SHORTEST_M:g} and {LONGEST_M:g} m can be followed")
    beyond = np.argwhere(np.abs(found.places_m) > FARTHEST_M)
    if beyond.size:
        row, column = beyond[0].tolist()
        raise InputError(
            f"{path}: line {found.lines[row]}: {'xy'[column]}_m: {found.places_m[row, column]:g}, and poses go "
            f"{FARTHEST_M:g} m from the origin at most; write way-points in the frame of the poses"
        )


def points_of(waypoints: Waypoints) -> tuple[Point, ...]:
    """The places as plain numbers."""
    return tuple((float(x), float(y)) for x, y in waypoints.places_m.tolist())


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {name}: {text!r} is not a finite number; write one")
    return value
