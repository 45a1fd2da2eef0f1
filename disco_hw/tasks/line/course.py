"""The line through way-points as a course: geometry, progress, speeds, hairpins, and headings that stay on it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from disco_hw.errors import FieldFault, InputError
from disco_hw.tasks import SLOWEST_M_S, Array, Chassis, Editable, Point, straight_fastest_m_s, too_fast
from disco_hw.tasks.line import SHARP_RAD, PathTable, Waypoints

if TYPE_CHECKING:
    from scipy.spatial import KDTree

# Chosen: shorter finds the nearest piece more surely, and makes the tree larger.
_PIECE_M = 0.05
# Chosen: a path may come near itself that often.
_NEAREST = 4
# Against a division by 0, and what counts as another place than the first.
_NO_LENGTH_M2 = 1e-18
_ELSEWHERE_M = 1e-6


@dataclass(frozen=True, eq=False, slots=True)
class LineCourse:
    """Straight pieces between way-points (N, 2), N >= 2; a position belongs to the nearest piece.

    `fine_m` (M, 2): the same line in pieces of at most 5 cm; `tree` finds the nearest of these.
    """

    noun: str
    points_m: Array
    fine_m: Array
    tree: KDTree

    @property
    def middle_m(self) -> Point:
        """The middle of the smallest upright rectangle around it."""
        x, y = (0.5 * (self.points_m.min(axis=0) + self.points_m.max(axis=0))).tolist()
        return x, y

    @property
    def reach_m(self) -> float:
        """Half of the longer side of that rectangle."""
        return 0.5 * float(np.ptp(self.points_m, axis=0).max())

    @property
    def length_m(self) -> float:
        """Sum of the pieces."""
        return float(np.hypot(*np.diff(self.points_m, axis=0).T).sum())

    @property
    def start(self) -> tuple[float, float, float]:
        """The first way-point, facing the next that is elsewhere."""
        x, y = self.points_m[0].tolist()
        away = self.points_m - self.points_m[0]
        to_x, to_y = away[int(np.argmax(np.hypot(away[:, 0], away[:, 1]) > _ELSEWHERE_M))].tolist()
        return x, y, math.atan2(to_y, to_x)

    def outline_m(self) -> Array:
        """Return the way-points (N, 2) as outline, m."""
        return self.points_m

    def off_m(self, places_m: Array) -> Array:
        """Distance (N,) of positions (N, 2), positive to the right of the nearest piece's direction."""
        begin, step = self.fine_m[:-1], np.diff(self.fine_m, axis=0)
        # What is no number is nowhere, and nothing for the tree to look for.
        known = np.isfinite(places_m).all(axis=1)
        if not known.all():
            found = np.full(len(places_m), np.nan)
            found[known] = self.off_m(places_m[known])
            return found
        # Of the nearest corners the pieces on both sides, as a path may cross itself.
        count = min(_NEAREST, len(self.fine_m))
        corners = self.tree.query(places_m, k=count)[1].reshape(len(places_m), count)
        pieces = np.clip(np.hstack((corners - 1, corners)), 0, len(step) - 1)
        along, offset = step[pieces], places_m[:, None, :] - begin[pieces]
        part = np.clip((offset * along).sum(axis=2) / np.maximum((along**2).sum(axis=2), _NO_LENGTH_M2), 0.0, 1.0)
        away = offset - part[..., None] * along
        distance = np.hypot(away[..., 0], away[..., 1])
        each, nearest = np.arange(len(places_m)), np.argmin(distance, axis=1)
        along, away = along[each, nearest], away[each, nearest]
        return np.asarray(np.copysign(distance[each, nearest], along[:, 1] * away[:, 0] - along[:, 0] * away[:, 1]))


@lru_cache(maxsize=8)
def line_course(points: tuple[Point, ...], noun: str) -> LineCourse:
    """Return the line through way-points, the same one for the same way-points; `noun` is what it is called."""
    # Loaded for paths alone: half of the daemon's commands need no course at all.
    from scipy.spatial import KDTree  # noqa: PLC0415

    corners = np.array(points, np.float64).reshape(-1, 2)
    at_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))))
    between = np.linspace(0.0, at_m[-1], max(2, math.ceil(at_m[-1] / _PIECE_M) + 1))
    fine_at_m = np.union1d(at_m, between)
    fine = np.column_stack([np.interp(fine_at_m, at_m, column) for column in corners.T])
    return LineCourse(noun, corners, fine, KDTree(fine))


END_M = 0.05
"""The end of an open path is reached so far before it: the planner slows down to nothing there."""


def describe_part(part: float, length_m: float) -> tuple[str, str]:
    """Return the word "progress" and the part behind of a line's length as text."""
    return "progress", f"{part * length_m:.2f} of {length_m:.2f} m ({part:.0%})"


class PathProgress:
    """Progress along a path, by the place nearest to the robot near the one before, as the planner sees it."""

    def __init__(self, path: PathTable) -> None:
        self._path = path
        self._entries = len(path.table) - 1
        self._place: float | None = None
        self._moved = 0.0
        self._paused = True

    @property
    def laps(self) -> float:
        """Laps of a closed path since the task started, or the part of an open one that is behind, 0 to 1."""
        if self._path.closed:
            return self._moved / self._entries
        return 1.0 if self._at_end else (self._place or 0.0) / self._entries

    @property
    def finished(self) -> bool:
        """Whether the end of an open path is reached."""
        return self._at_end and not self._path.closed and not self._paused

    @property
    def _at_end(self) -> bool:
        return self._place is not None and (self._entries - self._place) * self._path.spacing_m <= END_M

    def describe(self) -> tuple[str, str]:
        """Laps of a closed path, or metres of an open one and the part of the whole."""
        if self._path.closed:
            return "laps", f"{self.laps:.2f}"
        return describe_part(self.laps, self._entries * self._path.spacing_m)

    def add(self, _now_ns: int, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Take in the pose of one tick; the first one after a pause is looked for on the whole path."""
        before = None if self._paused else self._place
        self._place = self._path.place(x_m, y_m, yaw_rad, before)
        if before is None:
            self._moved, self._paused = 0.0, False
            return
        step = self._place - before
        if self._path.closed:
            step -= self._entries * round(step / self._entries)
        self._moved += step

    def pause(self) -> None:
        """Note that the task does not run in this tick."""
        self._paused = True


def straight_too_fast(speed_m_s: float, robot: Chassis) -> FieldFault | None:
    """Return the fault of a speed that the wheels cannot do straight ahead; None if they can."""
    return too_fast(speed_m_s, straight_fastest_m_s(robot), robot, "the wheels")


def speed_range(robot: Chassis) -> Mapping[str, Editable]:
    """Return the speed as the field that a person may change."""
    return {"speed_m_s": Editable(SLOWEST_M_S, straight_fastest_m_s(robot), "Speed (m/s)")}


SHARP_APART_M = 1.0
"""What two turns need between them of which each is sharp."""
BACK_RAD, BACK_APART_M, BACK_APART_X_ICR = math.radians(160.0), 0.28, 1.17
"""What turns need between them that together turn back: m, and so many times x_icr."""
ROUND_RAD, ROUND_APART_M, ROUND_APART_X_ICR = math.radians(200.0), 0.5, 2.1
"""What turns need between them that together turn further round than back: m, and so many times x_icr."""
# Of what turns back all but this is in one place, where the robot stops and turns.
_ELSEWHERE_RAD = math.radians(45.0)
# Pieces of the table that are one place.
_PLACE = 2


def refuse_hairpins(file: Path, waypoints: Waypoints, x_icr_m: float) -> None:
    """Raise InputError naming the lines of turns that are too near to one another for a robot with this x_icr."""
    found = hairpin(PathTable(waypoints.places_m), x_icr_m)
    if found is None:
        return
    begin_m, end_m, least_m = found
    at_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(waypoints.places_m, axis=0).T))])
    first, last = (waypoints.lines[int(np.argmin(np.abs(at_m - there_m)))] for there_m in (begin_m, end_m))
    raise InputError(
        f"{file}: lines {first} to {last}: the path turns twice within {least_m:.2f} m, where the robot would leave "
        f"it far; leave {math.ceil(10.0 * least_m) / 10.0:g} m between the turns, or turn at one way-point"
    )


def hairpin(path: PathTable, x_icr_m: float) -> tuple[float, float, float] | None:
    """Return the first turns that are too near to one another, and what they need between them, m along the path.

    Or None. Turning swings the tracked point aside, the further the larger `x_icr_m` is.
    """
    back_m = max(BACK_APART_M, BACK_APART_X_ICR * abs(x_icr_m))
    round_m = max(ROUND_APART_M, ROUND_APART_X_ICR * abs(x_icr_m))
    heading = _headings(path)
    length_m = path.spacing_m * (len(path.table) - 1)
    found = [
        pair
        for pair in (
            _sharp_pair(path, heading),
            _turn_back(path, heading, BACK_RAD, back_m),
            _turn_back(path, heading, ROUND_RAD, round_m),
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


# Chosen: the heading's equation grows stiff towards 0, where its solution is the line's direction.
SMALLEST_X_ICR_M = 0.01
# Chosen: what is so many times x_icr further along the line changes a heading by no more than rounding does.
_FORGETS_X_ICR = 40.0
# More than any turn that is no sharp one.
_MOST_TURNED_RAD = 2.6


def stable_yaw(along_rad: Array, spacing_m: float | Array, x_icr_m: float, closed: bool) -> Array:
    """Heading (M + 1,) at the begin of each of M pieces of these directions, and at the end of the last.

    `along_rad` (M,) is unwrapped; the pieces' length is one or (M,). The heading of a closed line repeats, that of any
    other ends along it. Below SMALLEST_X_ICR_M the tracked point goes where the robot heads.
    """
    if abs(x_icr_m) < SMALLEST_X_ICR_M:
        return np.append(along_rad, along_rad[-1])
    if x_icr_m < 0.0:
        # With the centre of rotation behind, the heading settles along the line.
        return stable_yaw(along_rad[::-1], np.flip(spacing_m), -x_icr_m, closed)[::-1]
    left = [math.exp(-one / x_icr_m) for one in np.broadcast_to(spacing_m, along_rad.shape).tolist()]
    turn = math.remainder(along_rad[0] - along_rad[-1], 2.0 * math.pi) + along_rad[-1] - along_rad[0] if closed else 0.0
    directions = along_rad.tolist()
    count = len(directions)
    # A closed line is gone round from behind its end.
    behind = math.ceil(_FORGETS_X_ICR * x_icr_m / float(np.mean(spacing_m))) if closed else 0
    after = directions[(behind - 1) % count]
    yaw = [after] * (count + 1)
    for place in range(behind + count - 1, -1, -1):
        at = place % count
        # The exact solution over a straight piece.
        half = 0.5 * (after - directions[at])
        after = directions[at] + 2.0 * math.atan2(left[at] * math.sin(half), math.cos(half))
        yaw[place if place < count else 0] = after
        if at == 0 and place:
            after += turn
            yaw[count] = after
    return np.array(yaw)


def turned_tangents(path: PathTable, x_icr_m: float, first: int, end: int) -> Array:
    """Tangents of half the angle that the robot is turned by from each piece, at its begin and the rest to its end.

    (M, 2); a robot on the line faces across it, or backwards along it, where it turns by more than a right angle.

    Of the pieces `first` to `end` - 1, which on a closed path may be counted beyond its table. The line further on
    counts as far as the heading remembers it.
    """
    count = len(path.table) - 1
    remembered = math.ceil(_FORGETS_X_ICR * abs(x_icr_m) / path.spacing_m)
    # Which way the heading depends on the line.
    begin, stop = (first, end + remembered) if x_icr_m > 0.0 else (first - remembered, end)
    if not path.closed:
        begin, stop = max(begin, 0), min(stop, count)
    at = np.arange(begin, stop)
    along = np.unwrap(np.arctan2(path.table[at % count, 3], path.table[at % count, 2]))
    turned = np.empty((at.size, 2))
    # A robot stops where the path turns sharply: what comes after says nothing of the heading before.
    sharp = np.flatnonzero(np.isin(at % count, path.sharp_turns))
    for here, there in pairwise(sorted({0, *sharp.tolist(), at.size})):
        yaw = stable_yaw(along[here:there], path.spacing_m, x_icr_m, False)
        turned[here:there] = np.column_stack([yaw[:-1], yaw[1:]]) - along[here:there, None]
    part = turned[first - begin : end - begin]
    tangents = np.tan(0.5 * np.clip(part, -_MOST_TURNED_RAD, _MOST_TURNED_RAD))
    return np.column_stack([tangents[:, 0], tangents[:, 1] - tangents[:, 0]])
