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
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); give the path of a CSV of way-points") from None
    header = rows[0].keys() if rows else ()
    for name in ("x_m", "y_m"):
        if name not in header:
            raise InputError(f"{path}: column {name}: missing; the first line must name x_m and y_m")
    if len(rows) < 2:
        raise InputError(f"{path}: only {len(rows)} way-point; write at least two")
    columns = {
        name: np.array([_number(path, line, name, row[name]) for line, row in enumerate(rows, start=2)])
        for name in ("x_m", "y_m", "t_s")
        if name in header
    }
    places = np.column_stack([columns["x_m"], columns["y_m"]])
    times = columns.get("t_s")
    if times is None:
        apart = np.hypot(*np.diff(places, axis=0).T)
        if np.any(apart < LEAST_DISTANCE_M):
            line = int(np.argmax(apart < LEAST_DISTANCE_M)) + 3
            raise InputError(f"{path}: line {line}: the same way-point again; remove it, or give times in t_s")
    elif np.any(np.diff(times) <= 0.0):
        line = int(np.argmax(np.diff(times) <= 0.0)) + 3
        raise InputError(f"{path}: line {line}: t_s does not increase; sort the way-points by time")
    return Waypoints(places, times)


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {name}: {text!r} is not a finite number; write one")
    return value
