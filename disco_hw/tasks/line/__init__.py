"""Shared parts of tasks that follow a line of way-points: their file, and the line as a table with places on it.

Course, progress and cost lie beside this file. The table is the way-points of a CSV in equal pieces of arc length.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from disco_hw.errors import InputError
from disco_hw.files import WAY_POINTS, read_lines
from disco_hw.tasks import Array, Point
from drivers.samples import FARTHEST_M

# Chosen: smaller follows corners more closely, which refined plans are exact enough for, and makes the table longer.
SPACING_M = 0.02
REFINED_SPACING_M = 0.01
# Entries closer than this part of the spacing lie on either side of a turn straight back.
FOLDED = 0.01
# Chosen: ends this close are meant to meet, as where the file rounds or somebody recorded a lap by hand.
CLOSED_M = 0.02
LOOK_BACK_M = 0.3
LOOK_AHEAD_M = 1.0
LOST_M = 1.0
# Where the way turns by more than SHARP from one TURN_M to the next, the robot stops, within REACHED_M, and turns.
SHARP_RAD = math.radians(125.0)
TURN_M = 0.15
REACHED_M = 0.05
# More than this between one entry and the next is a corner.
CORNER_RAD = math.radians(20.0)
# Branches of which none is further off than the nearest by so much may be meant; facing straight against one counts as
# much as being so much further off it.
BRANCHES_M = 0.3
AGAINST_BRANCH_M = 0.6
# Chosen: laps this close, which go the same way within SAME_WAY_RAD, differ by less than poses and recorded laps do.
SAME_PLACE_M = 0.1
SAME_WAY_RAD = math.radians(45.0)


class PathTable:
    """Way-points (N, 2) in equal pieces of arc length, of about `nominal_spacing_m`; immutable.

    Where the way turns sharply it is cut into pieces: the robot stops at a piece's end and turns to the next. The path
    is `closed` if its last way-point is within CLOSED_M of its first, and then ends there. `table`: x, y (m) of each
    entry, and the unit tangent of the piece that begins there; `spacing_m`: arc length between two entries. Raises
    ValueError for way-points closer than the table's spacing throughout.
    """

    def __init__(self, places_m: Array, nominal_spacing_m: float = SPACING_M) -> None:
        from_first_m = np.hypot(*(places_m - places_m[0]).T)
        self.closed = closed = bool(from_first_m[-1] < CLOSED_M)
        if closed and from_first_m[-1] > 0.0 and from_first_m.max() >= CLOSED_M:
            # Without those about the first, which may lie beyond it: the way would turn back to it.
            last = int(np.flatnonzero(from_first_m >= CLOSED_M)[-1])
            places_m = np.vstack([places_m[: last + 1], places_m[:1]])
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places_m, axis=0).T))])
        count = round(distance[-1] / nominal_spacing_m)
        if count < 1:
            raise ValueError(f"the path is {distance[-1]} m long; it must be longer than {nominal_spacing_m} m")
        at = np.linspace(0.0, distance[-1], count + 1)
        x, y = np.interp(at, distance, places_m[:, 0]), np.interp(at, distance, places_m[:, 1])
        # Where the way turns straight back between two entries they may coincide, and there would be no direction: the
        # first of them moves out to the way-point at which it turns.
        (folds,) = np.nonzero(np.hypot(np.diff(x), np.diff(y)) < FOLDED * distance[-1] / count)
        turns = np.searchsorted(distance, at[folds], side="right")
        x[folds], y[folds] = places_m[turns].T
        self.spacing_m: float = float(distance[-1]) / count
        corners = sharp_turns(np.column_stack([x, y]), closed, max(1, round(TURN_M / self.spacing_m)))
        x, y = _rounded(np.column_stack([x, y]), closed).T
        step_x, step_y = np.diff(x), np.diff(y)
        length = np.maximum(np.hypot(step_x, step_y), 1e-12)
        along_x = np.append(step_x / length, (step_x / length)[0 if closed else -1])
        along_y = np.append(step_y / length, (step_y / length)[0 if closed else -1])
        self.table = np.column_stack([x, y, along_x, along_y])
        bounds = [*corners, *(corner + count for corner in corners[:1])] if closed else [0, *corners, count]
        self._bounds = np.array(bounds, dtype=float)

    @property
    def sharp_turns(self) -> tuple[int, ...]:
        """Entries of the table at which the robot stops to turn."""
        ends = slice(0, -1) if self.closed else slice(1, -1)
        return tuple(self._bounds.astype(int)[ends].tolist())

    @property
    def ends(self) -> bool:
        """Whether rollouts end somewhere: at the path's end or before a sharp turn."""
        return bool(self._bounds.size)

    def piece(self, place: float) -> tuple[float, float, float]:
        """Return the piece that a place is on: the place, not less than the piece's first entry.

        Its first and last entry.

        A piece of a closed path may go past the table's end, and so may the place. A path without sharp turns is one
        piece; of a closed one, which has no end, the last entry is the first again.
        """
        bounds, count = self._bounds, len(self.table) - 1
        if not bounds.size:
            return place % count, 0.0, float(count)
        if self.closed:
            place = place % count
            place += count if place < bounds[0] else 0.0
        at = min(int(np.searchsorted(bounds, place, side="right")), bounds.size - 1)
        return place, float(bounds[at - 1]), float(bounds[at])

    def place(self, x_m: float, y_m: float, yaw_rad: float, before: float | None) -> float:
        """Entry of the table nearest to a pose: near the one before, or anywhere without one or off the path.

        Near the one before means on the same piece; at the end of a piece the next one begins. Where several branches
        pass by, the first place is on the one that the heading fits; of laps over the same ground, it is on the first.
        A robot that was off the path goes on with the lap that it was on.
        """
        count, spacing = len(self.table) - 1, self.spacing_m
        if before is not None:
            here, first, last = self.piece(before)
            low, high = round(here - LOOK_BACK_M / spacing), round(here + LOOK_AHEAD_M / spacing)
            if self._bounds.size:
                low, high = max(low, int(first)), min(high, int(last))
            if low >= 0 and high <= count:
                rows = self.table[low : high + 1]
            else:
                rows = self.table[np.arange(low, high + 1) % count]
            square = (rows[:, 0] - x_m) ** 2 + (rows[:, 1] - y_m) ** 2
            nearest = int(square.argmin())
            if square[nearest] < LOST_M**2:
                found = float(low + nearest)
                if self._bounds.size and (self.closed or last < count) and (last - found) * spacing <= REACHED_M:
                    found = last
                return found % count if self.closed else found
        return float(self._branch(x_m, y_m, yaw_rad, before or 0.0))

    def _branch(self, x_m: float, y_m: float, yaw_rad: float, near: float) -> int:
        """Entry where the branch is nearest whose distance and direction together fit a pose best.

        Of laps over the same ground, the one whose entry is closest to `near`.
        """
        distance = np.hypot(self.table[:, 0] - x_m, self.table[:, 1] - y_m)
        nearest = int(np.argmin(distance))
        if not (math.isfinite(yaw_rad) and math.isfinite(distance[nearest])):
            return nearest
        if self.closed:
            before, after = np.roll(distance[:-1], 1), np.roll(distance[:-1], -1)
            before, after = np.append(before, before[0]), np.append(after, after[0])
        else:
            before, after = np.append(np.inf, distance[:-1]), np.append(distance[1:], np.inf)
        branches = np.flatnonzero((distance <= before) & (distance < after))
        branches = np.append(nearest, branches[distance[branches] < distance[nearest] + BRANCHES_M])
        along = self.table[branches, 2] * math.cos(yaw_rad) + self.table[branches, 3] * math.sin(yaw_rad)
        best = branches[np.argmin(distance[branches] + 0.5 * AGAINST_BRANCH_M * (1.0 - along))]
        # Noise must not choose among laps.
        apart = np.abs(branches - best)
        apart = np.minimum(apart, len(self.table) - 1 - apart) if self.closed else apart
        aside_x, aside_y = (self.table[branches, :2] - self.table[best, :2]).T
        again = (apart * self.spacing_m > LOOK_BACK_M) & (np.hypot(aside_x, aside_y) < SAME_PLACE_M)
        again &= self.table[branches, 2:] @ self.table[best, 2:] > math.cos(SAME_WAY_RAD)
        laps = np.append(best, branches[again])
        return int(laps[np.argmin(np.abs(laps - near))])


def planned_table(points: Sequence[Point], mode: str) -> PathTable:
    """Return the table that the planner of a control mode follows: a finer one where plans are refined."""
    return PathTable(np.array(points), REFINED_SPACING_M if mode == "default" else SPACING_M)


def _rounded(points: Array, closed: bool) -> Array:
    """Points (M + 1, 2) with corners drawn in by a quarter of a piece, but for sharp ones, where the robot stops.

    A place moves on by its piece's direction. Round the inside of a corner it would not move on at all until the robot
    had got to the corner's outside.
    """
    steps = np.diff(points, axis=0)
    ends = (steps[-2:], steps[:2]) if closed else (steps[[0, 0]], steps[[-1, -1]])
    padded = np.vstack([ends[0], steps, ends[1]])
    heading = np.unwrap(np.arctan2(padded[:, 1], padded[:, 0]))
    # At each point over the two pieces that it joins, and over one more on either side.
    here, around = heading[2:-1] - heading[1:-2], heading[3:] - heading[:-3]
    at = np.flatnonzero((np.abs(here) > CORNER_RAD) & (np.abs(around) < SHARP_RAD))
    rounded = points.copy()
    rounded[at] += 0.25 * (padded[at + 2] - padded[at + 1])
    return rounded


def sharp_turns(points: Array, closed: bool, reach: int) -> list[int]:
    """Return indices of points (M + 1, 2) where the way turns by more than SHARP_RAD over `reach` points each way.

    The sharpest of any that are within `reach` of one another; in rising order. The last point of a closed way is its
    first, and not listed again.
    """
    count = len(points) - 1
    index = np.arange(count) if closed else np.arange(1, count)
    before, after = index - reach, index + reach
    before, after = (before % count, after % count) if closed else (np.maximum(before, 0), np.minimum(after, count))
    came, goes = points[index] - points[before], points[after] - points[index]
    cosine = (came * goes).sum(axis=1)
    sharp = cosine < math.cos(SHARP_RAD) * np.hypot(*came.T) * np.hypot(*goes.T)
    found: list[int] = []
    # Where the way turns back, points before the turn look as sharp, but not over as long a way.
    for at in np.flatnonzero(sharp)[np.argsort(cosine[sharp], kind="stable")]:
        apart = [abs(int(index[at]) - other) for other in found]
        if all(min(gap, count - gap) > reach if closed else gap > reach for gap in apart):
            found.append(int(index[at]))
    return sorted(found)


# Below the digits of a file: the same point, written twice.
LEAST_DISTANCE_M = 1e-6
# Chosen: a shorter path is a robot at rest; a longer one makes a table too large for the planner, as do more points.
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
            raise InputError(f"{path}: line {line}: repeats the way-point before it; remove it, or give times in t_s")
    elif np.any(np.diff(times) <= 0.0):
        line = lines[int(np.argmax(np.diff(times) <= 0.0)) + 1]
        raise InputError(f"{path}: line {line}: t_s does not increase; sort the way-points by time")
    return Waypoints(places, times, tuple(lines))


def _columns(path: Path) -> tuple[list[int], dict[str, Array]]:
    """Return the lines of the rows, and the columns that there are of x_m, y_m and t_s."""
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
            f"{path}: line {found.lines[row]}: {'xy'[column]}_m: {found.places_m[row, column]:g} is more than "
            f"{FARTHEST_M:g} m from the origin; write way-points in the frame of the poses"
        )


def points_of(waypoints: Waypoints) -> tuple[Point, ...]:
    """Return the places as plain numbers."""
    return tuple((float(x), float(y)) for x, y in waypoints.places_m.tolist())


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"{path}: line {line}: {name}: {text!r} is not a finite number; write one")
    return value
