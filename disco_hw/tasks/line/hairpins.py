"""Where a path turns back within less ground than the robot needs for it: found before it is driven.

A robot that has stopped across the way finds nothing better than to stand. In simulated drives two turns brought it to
that where they were this near to one another; one turn at one place did not, whatever its angle.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from disco_hw.errors import InputError
from disco_hw.tasks.line.table import SHARP_RAD, PathTable
from disco_hw.tasks.line.waypoints import Waypoints
from disco_hw.tasks.task import Array

SHARP_APART_M = 1.0
"""What two turns need between them of which each is sharp."""
BACK_RAD, BACK_APART_M = math.radians(160.0), 0.28
"""What turns need between them that together turn back."""
ROUND_RAD, ROUND_APART_M = math.radians(200.0), 0.5
"""What turns need between them that together turn further round than back."""
# Of what turns back all but this is in one place, where the robot stops and turns.
_ELSEWHERE_RAD = math.radians(45.0)
# Pieces of the table that are one place.
_PLACE = 2


def refuse_hairpins(file: Path, waypoints: Waypoints) -> None:
    """Raise InputError naming the lines of turns that are too near to one another for the robot to get past."""
    found = hairpin(PathTable(waypoints.places_m))
    if found is None:
        return
    begin_m, end_m, least_m = found
    at_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints.places_m, axis=0).T))])
    first, last = (waypoints.lines[int(np.argmin(np.abs(at_m - there_m)))] for there_m in (begin_m, end_m))
    raise InputError(
        f"{file}: lines {first} to {last}: the way turns twice within {least_m:g} m, too near for the robot, which may "
        f"stop there for good; leave {math.ceil(10.0 * least_m) / 10.0:g} m between the turns, or turn at one way-point"
    )


def hairpin(path: PathTable) -> tuple[float, float, float] | None:
    """The first turns that are too near to one another, and what they need between them, m along the path; or None."""
    heading = _headings(path)
    length_m = path.spacing_m * (len(path.table) - 1)
    found = [
        pair
        for pair in (
            _sharp_pair(path, heading),
            _turn_back(path, heading, BACK_RAD, BACK_APART_M),
            _turn_back(path, heading, ROUND_RAD, ROUND_APART_M),
        )
        if pair is not None
    ]
    if not found:
        return None
    begin, end, least_m = min(found)
    return begin * path.spacing_m % length_m, end * path.spacing_m % length_m, least_m


def _headings(path: PathTable) -> Array:
    """Heading of every piece of the path's table without jumps (rad), and of a closed one as far on as is looked."""
    along = path.table[:-1, 2:]
    if path.closed:
        along = along[np.arange(len(along) + math.ceil(SHARP_APART_M / path.spacing_m)) % len(along)]
    return np.asarray(np.unwrap(np.arctan2(along[:, 1], along[:, 0])))


def _sharp_pair(path: PathTable, heading: Array) -> tuple[int, int, float] | None:
    """Entries of two sharp turns, each at one place."""
    sharp = np.flatnonzero(np.abs(heading[_PLACE:] - heading[:-_PLACE]) > SHARP_RAD) + 1
    apart = np.diff(sharp)
    near = np.flatnonzero((apart > _PLACE) & (apart * path.spacing_m < SHARP_APART_M - path.spacing_m))
    return (int(sharp[near[0]]), int(sharp[near[0] + 1]), SHARP_APART_M) if near.size else None


def _turn_back(path: PathTable, heading: Array, turned_rad: float, least_m: float) -> tuple[int, int, float] | None:
    """Entries between which the way turns by more than `turned_rad`, one way round, and not at one place."""
    for apart in range(_PLACE + 1, min(math.ceil(least_m / path.spacing_m - 1e-6) + 1, len(heading))):
        turned = heading[apart:] - heading[:-apart]
        for at in np.flatnonzero(np.abs(turned) > turned_rad).tolist():
            within = heading[at : at + apart + 1]
            if abs(turned[at]) - np.abs(within[_PLACE:] - within[:-_PLACE]).max() > _ELSEWHERE_RAD:
                return at + 1, at + apart, least_m
    return None
