"""Way-points from a CSV: places to pass, in order, with or without the times to be there."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError

Array = NDArray[np.float64]
LEAST_DISTANCE_M = 1e-6
SHORTEST_M = 0.1
LONGEST_M = 2000.0
MOST_POINTS = 10_000


@dataclass(frozen=True, eq=False, slots=True)
class Waypoints:
    """Places (N, 2) in the world frame (m) and times (N,) from the start (s), or None."""

    places_m: Array
    times_s: Array | None = None


def load_waypoints(path: Path) -> Waypoints:
    """Read a CSV with columns x_m, y_m and perhaps t_s, by name, in any order; other columns are ignored.

    Raises InputError with one line naming file, place and remedy: a file that cannot be read, a missing column, a cell
    that is not a finite number, fewer than two way-points, one repeated, times that do not increase.
    """
    try:
        # Spreadsheets write a mark before the first column's name.
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = reader.fieldnames or ()
            numbered = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); give the path of a CSV of way-points") from None
    for name in ("x_m", "y_m"):
        if name not in header:
            raise InputError(f"{path}: line 1: column {name}: missing; name x_m and y_m there, with a comma between")
    if len(numbered) < 2:
        raise InputError(f"{path}: {len(numbered)} way-points; write at least two")
    lines = [line for line, _ in numbered]
    columns = {
        name: np.array([_number(path, line, name, row[name]) for line, row in numbered])
        for name in ("x_m", "y_m", "t_s")
        if name in header
    }
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
    return Waypoints(places, times)


def way_points_to_follow(path: Path) -> Waypoints:
    """The way-points of a CSV that a robot is to follow at a speed of its own.

    Raises InputError as `load_waypoints`, and for times, for more than 10 000 way-points, and for a path that is
    shorter than 0.1 m or longer than 2 km.
    """
    found = load_waypoints(path)
    if found.times_s is not None:
        raise InputError(f"{path}: line 1: column t_s: the robot follows at task.speed_m_s; remove the column")
    if len(found.places_m) > MOST_POINTS:
        raise InputError(f"{path}: {len(found.places_m)} way-points; write at most {MOST_POINTS}")
    length_m = float(np.hypot(*np.diff(found.places_m, axis=0).T).sum())
    if not SHORTEST_M <= length_m <= LONGEST_M:
        raise InputError(f"{path}: {length_m:g} m long; between {SHORTEST_M:g} and {LONGEST_M:g} m can be followed")
    return found


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {name}: {text!r} is not a finite number; write one")
    return value
