"""The cost of following way-points by arc length, at a constant speed, and of stopping at their end."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.tasks import Found, Prepared, constant, helper, norm_and_inverse, norm_of_three, single
from disco_hw.tasks.line import PathTable
from disco_hw.tasks.line.course import turned_tangents

# Chosen: time constant of coming to the end; shorter brakes later and harder.
SLOW_DOWN_S = 1.0
# Chosen: further than a step of the plan can drive; keeps the place from jumping to another part of the path.
FARTHEST_STEP_M = 0.5
# Facing straight against the way costs as much as being so far off it.
AGAINST_M = 0.6
# Standing costs at least as much as being so far off the path, however slow it is to be driven.
STANDING_M = 0.2
# The last distance counts as much as over so much more of the way: turning in pushes the tracked point out at first.
TERMINAL_M = 0.2
# The last heading's error counts so many times the distance that it swings the tracked point by.
TURN_WEIGHT = 2.0
# Beliefs this close share a table.
SAME_X_ICR_M = 0.005
# Entries of the table that rollouts see relative to the same point: few, as single precision resolves 0.1 um of 1 m.
NEAR = 50
_ZERO, _ONE, _TWO, _AGAINST = single(0.0), single(1.0), single(2.0), single(AGAINST_M)


@dataclass(frozen=True, eq=False)
class PathCost:
    """Cost of following way-points: the distance e, the error of the speed along the path, and facing backwards.

    The place on the path is carried along every rollout: each step moves it by the step's projection on the path's
    direction; so a path may cross itself. The speed of that is the progress, but no more than the forward speed and the
    wanted one together: a robot that slides round a corner makes progress sideways, one that stands or drives backwards
    makes none. Facing is AGAINST_M times the part of the heading that is against the path's direction: backwards would
    else be the easier way, for it puts the tracked point before the axle. Wanted is `speed_m_s`, and less in the last
    second of an open path. The end costs the distance that is left, over TERMINAL_M more of the way, together with the
    error of the heading from that of a robot that stays on the path; else the tracked point would be swung to the path
    at the end.

    Where the way turns sharply, rollouts end at the end of the table's piece, the robot stops there, and then turns to
    the next, which it could not find by sampling as nothing is gained before the turn is half done.
    """

    path: PathTable
    speed_m_s: float = 0.2

    def prepare(
        self, time_s: float, x_m: float, y_m: float, yaw_rad: float, memory: float | None, step_s: float, horizon: int,
        x_icr_m: float = 0.0,
    ) -> Prepared:  # fmt: skip
        """Return kernel terms, the rollouts' origin and first memory (0), and the place on the path for the next plan.

        Places count in entries of the table. Rollouts count them from where they begin, and are
        relative to a point of the path nearby, so that a long path is as precise as a short one.
        """
        path = self.path
        place, first, last = path.piece(path.place(x_m, y_m, yaw_rad, memory))
        reach = horizon * math.ceil(FARTHEST_STEP_M / path.spacing_m) + 1
        x_icr_m = SAME_X_ICR_M * round(x_icr_m / SAME_X_ICR_M)
        near = _nearby(path, int(place) // NEAR, reach, x_icr_m)
        low, high, end = place - reach, place + reach, math.inf
        if path.ends:
            low, high, end = max(low, first), min(high, last), last - place
        begin, rows = int(low) - near.first, int(high - low)
        terms = PathTerms(
            near.pieces[4 * begin : 4 * (begin + rows)],
            near.turned[2 * begin : 2 * (begin + rows)],
            single(low - place),
            single(high - place),
            single(end),
            *_numbers(path, self.speed_m_s, step_s, abs(x_icr_m)),
        )
        return Prepared(terms, near.origin_m, 0.0, place)

    def line_m(self) -> NDArray[np.float64]:
        """Return the path as points (N, 2)."""
        return self.path.table[:, :2]


class PathTerms(NamedTuple):
    """The cost along the part of a path's table that can be reached within the horizon.

    `table` (4 M,): for each piece between two entries, from one to the next, where it begins, x and y (m), and how far
    it goes in x and y (m). `turned` (2 M,): the tangent of half the angle by which a robot on the path is turned from
    each piece at its begin, and how much more at its end (`course.turned_tangents`). Places count in entries from where
    the robot is: `first` and `last` are the table's ends, `end` is where the robot stops, or infinite. `per_m`:
    entries a metre; `speed_m_s`; `speed_per_entry`: progress speed of one entry in a step (m/s); `slow_per_entry`:
    wanted speed for each entry left; `speed_weight`: of missing speed; `terminal_steps`: weight of the last
    distance; `turn_m`: what the last heading counts if it is straight across, and half of what it does backwards (m).
    """

    table: NDArray[np.float32]
    turned: NDArray[np.float32]
    first: float
    last: float
    end: float
    per_m: float
    speed_m_s: float
    speed_per_entry: float
    slow_per_entry: float
    speed_weight: float
    terminal_steps: float
    turn_m: float

    def follow(self, memory: float, x: float, y: float, forward: float, found: Found) -> tuple[float, float]:
        """Return the place after a step, and what the step misses of the wanted speed, weighted."""
        off_x, off_y, along_x, along_y = _offset(self.last, memory, x, y, found[1:])
        # A `single` of its own makes the compiler round another product: old logs would give other last bits.
        farthest = constant(FARTHEST_STEP_M, x)
        along = min(max(off_x * along_x + off_y * along_y, -farthest), farthest) * self.per_m
        desired = min(self.speed_m_s, (self.end - memory) * self.slow_per_entry)
        missing = self.speed_weight * (desired - min(along * self.speed_per_entry, forward + desired))
        # In this order, so that what is no number becomes a place, and the cost shows it.
        return min(self.last, max(self.first, memory + along)), missing

    def place_of(self, place: float, x: float, y: float) -> float:
        """Return the place beside a position, from the one before."""
        row = 4 * _row(place, self.first, self.last)
        piece = (self.table[row], self.table[row + 1], self.table[row + 2], self.table[row + 3])
        off_x, off_y, along_x, along_y = _offset(self.last, place, x, y, piece)
        along = min(max(off_x * along_x + off_y * along_y, -FARTHEST_STEP_M), FARTHEST_STEP_M)
        moved = min(self.last, max(self.first, place + along * self.per_m))
        if along < _ZERO:
            row = 4 * _row(moved, self.first, self.last)
            piece = (self.table[row], self.table[row + 1], self.table[row + 2], self.table[row + 3])
            off_x, off_y, along_x, along_y = _offset(self.last, moved, x, y, piece)
            if off_x * along_x + off_y * along_y > -along:
                # Beyond a corner: from the way before it the place would come back by more, and so on for ever.
                return place
        return moved

    def line_at(self, place: float, ahead_m: float) -> tuple[float, float, float, float, float, float]:
        """Return x, y, cosine and sine of the heading, cosine of heading against path, and speed, `ahead_m` further on.

        The heading is that of a robot that stays on the path; its angle with the path is `turned`'s.
        """
        place = min(place + ahead_m * self.per_m, self.last)
        index = _row(place, self.first, self.last)
        row, part = 4 * index, place - np.floor(min(place, self.last - _ONE))
        step_x, step_y = self.table[row + 2], self.table[row + 3]
        _, per_m = norm_and_inverse(step_x, step_y)
        cosine, sine = _turned(self.turned[2 * index] + part * self.turned[2 * index + 1])
        along_x, along_y = step_x * per_m, step_y * per_m
        speed = min(self.speed_m_s, max((self.end - place) * self.slow_per_entry, _ZERO))
        x, y = self.table[row] + part * step_x, self.table[row + 1] + part * step_y
        return x, y, along_x * cosine - along_y * sine, along_y * cosine + along_x * sine, cosine, speed

    def way_ahead_m(self, time_s: float) -> float:
        """Return the distance (m) that a robot on the path covers in `time_s`, up to the path's end; Python only."""
        return float(min(self.speed_m_s * time_s, max(self.end, 0.0) / self.per_m))

    def row_of(self, memory: float) -> int:
        """Return the index of the table's row for a place."""
        row: int = np.int32(np.floor(min(memory, self.last - _ONE)) - self.first)  # type: ignore[assignment]
        return row

    def stage(
        self, memory: float, step: int, x_old: float, y_old: float, x: float, y: float,
        cos_yaw: float, sin_yaw: float, forward: float, found: Found,
    ) -> tuple[float, float]:  # fmt: skip
        """Return the cost of a step (m) and the unchanged memory.

        The cost is the distance to the path and the missing speed as one length, and what facing backwards adds.
        """
        off_x, off_y, along_x, along_y = _offset(self.last, memory, x, y, found[1:])
        against = max(-(cos_yaw * along_x + sin_yaw * along_y), _ZERO)
        return norm_of_three(off_x, off_y, found[0]) + _AGAINST * against, memory

    def terminal(self, memory: float, x: float, y: float, cos_yaw: float, sin_yaw: float, found: Found) -> float:
        """Return the weighted cost of the last distance and the last heading's error, as one length (m)."""
        off_x, off_y, along_x, along_y = _offset(self.last, memory, x, y, found[1:])
        piece = np.floor(min(memory, self.last - _ONE))
        row = np.int32(piece - self.first) * 2
        cosine, sine = _turned(self.turned[row] + (memory - piece) * self.turned[row + 1])
        along, across = cos_yaw * along_x + sin_yaw * along_y, sin_yaw * along_x - cos_yaw * along_y
        forwards, turn = along * cosine + across * sine, abs(across * cosine - along * sine)
        turn = turn if forwards > _ZERO else _TWO - turn
        return self.terminal_steps * norm_of_three(off_x, off_y, self.turn_m * turn)


@helper
def _row(place: float, first: float, last: float) -> int:
    """Return the index of the table's row for a place."""
    return int(np.floor(min(place, last - _ONE)) - first)


@helper
def _turned(tangent: float) -> tuple[float, float]:
    """Cosine and sine of an angle, from the tangent of its half."""
    whole = _ONE / (_ONE + tangent * tangent)
    return (_ONE - tangent * tangent) * whole, (tangent + tangent) * whole


@helper
def _offset(
    last: float, place: float, x: float, y: float, piece: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Position relative to the path's point at a place (m), and the direction of the path there; `piece` is its row."""
    begin_x, begin_y, step_x, step_y = piece
    part = place - np.floor(min(place, last - _ONE))
    _, per_m = norm_and_inverse(step_x, step_y)
    return x - (begin_x + part * step_x), y - (begin_y + part * step_y), step_x * per_m, step_y * per_m


class _Nearby(NamedTuple):
    """Part of a path, flat as in PathTerms, from the entry `first` on and relative to `origin_m`."""

    pieces: NDArray[np.float32]
    turned: NDArray[np.float32]
    first: int
    origin_m: tuple[float, float]


@lru_cache(maxsize=8)
def _nearby(path: PathTable, block: int, reach: int, x_icr_m: float) -> _Nearby:
    """Return the block of NEAR entries of a path, and `reach` more on both sides: round and round if it is closed."""
    table, count = path.table, len(path.table) - 1
    first, end = block * NEAR - reach, (block + 1) * NEAR + reach
    if not path.closed:
        first, end = max(first, 0), min(end, count)
    at = np.arange(first, end) % count
    here, there = table[at, :2], table[at + 1, :2]
    # An open path's last entry is one of its own: it is not the first.
    origin = table[block * NEAR % count if path.closed else block * NEAR, :2]
    pieces = np.hstack([here - origin, there - here]).astype(np.float32)
    turned = turned_tangents(path, x_icr_m, first, end).astype(np.float32)
    x_m, y_m = origin.tolist()
    return _Nearby(pieces.reshape(-1), turned.reshape(-1), first, (x_m, y_m))


@lru_cache(maxsize=8)
def _numbers(path: PathTable, speed_m_s: float, step_s: float, x_icr_m: float) -> tuple[float, ...]:
    """Return the terms from `per_m` on: those that no plan changes."""
    spacing = path.spacing_m
    return tuple(
        single(value)
        for value in (
            1.0 / spacing,
            speed_m_s,
            spacing / step_s,
            spacing / SLOW_DOWN_S,
            max(1.0, STANDING_M / speed_m_s),
            TERMINAL_M / (speed_m_s * step_s),
            TURN_WEIGHT * x_icr_m,
        )
    )
