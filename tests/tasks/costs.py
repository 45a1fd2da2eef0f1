"""The costs of tasks over whole paths, in numpy and double precision, written apart from what is compiled."""

from __future__ import annotations

import math

import numpy as np

from disco_hw.tasks import circle as circle_file
from disco_hw.tasks.circle import MOST_TURNED, CircleCost
from disco_hw.tasks.line import PathTable, Waypoints
from disco_hw.tasks.line.cost import (
    AGAINST_M,
    FARTHEST_STEP_M,
    SAME_X_ICR_M,
    SLOW_DOWN_S,
    STANDING_M,
    TERMINAL_M,
    TURN_WEIGHT,
    PathCost,
)
from disco_hw.tasks.line.course import stable_yaw
from disco_hw.tasks.timed_path import RESTS_M, TimedPathCost
from tests.control.oracle import Array, SequenceCost


def path_along(waypoints: Waypoints, speed_m_s: float = 0.2) -> PathCost:
    """The cost of following way-points."""
    return PathCost(PathTable(waypoints.places_m), speed_m_s)


def instant_cost(
    task: CircleCost | PathCost | TimedPathCost, x_m: float, y_m: float, forward_m_s: float, time_s: float = 0.0
) -> float:
    """Distance to the line and error of the forward speed as one length; of a timed path to where the robot should be.

    The paper's cost of an instant.
    """
    if isinstance(task, TimedPathCost):
        times_s, places_m = task.waypoints.times_s, task.waypoints.places_m
        due_x_m, due_y_m = (np.interp(time_s, times_s, column) for column in places_m.T)
        return math.hypot(due_x_m - x_m, due_y_m - y_m)
    if isinstance(task, CircleCost):
        off_m = math.hypot(x_m - task.center_x_m, y_m - task.center_y_m) - task.radius_m
    else:
        off_m = np.hypot(*(task.path.table[:, :2] - (x_m, y_m)).T).min()
    return math.hypot(off_m, forward_m_s - task.speed_m_s)


def circle_cost(circle: CircleCost, step_s: float, x_icr_m: float = 0.0) -> SequenceCost:
    """Cost of paths x, y, yaw (T + 1, K) and forward speeds (T, K) round a circle; see `CircleCost`.

    A robot that goes round with its tracked point on the circle is turned inwards by asin(x_icr / radius).
    """
    inwards = math.asin(min(max(x_icr_m / circle.radius_m, -MOST_TURNED), MOST_TURNED))

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        x, y = x - circle.center_x_m, y - circle.center_y_m
        off_edge = np.hypot(x[1:], y[1:]) - circle.radius_m
        paper = np.hypot(off_edge, forward - circle.speed_m_s).sum(axis=0)
        closest = np.maximum(x[1:] ** 2 + y[1:] ** 2, (circle.radius_m / 2.0) ** 2)
        angle = (x[:-1] * y[1:] - y[:-1] * x[1:]) / closest
        missing = circle.progress_part * circle.speed_m_s * len(forward) - circle.radius_m / step_s * angle.sum(axis=0)
        way = np.arctan2(y[1:], x[1:]) + 0.5 * math.pi
        facing = circle.against_m * np.maximum(-np.cos(yaw[1:] - way), 0.0).sum(axis=0)
        swung = circle_file.TURN_WEIGHT * abs(x_icr_m) * turned_away(yaw[-1] - way[-1] - inwards)
        last = circle.terminal_m / (circle.speed_m_s * step_s) * np.hypot(off_edge[-1], swung)
        return np.asarray(paper + facing + circle.progress_weight * np.maximum(missing, 0.0) + last)

    return cost


def turned_away(angle: Array) -> Array:
    """Sine of an angle up to a right one, and what it misses of 2 beyond."""
    return np.where(np.cos(angle) > 0.0, np.abs(np.sin(angle)), 2.0 - np.abs(np.sin(angle)))


def facing_cost(yaw: Array, along_x: Array | float, along_y: Array | float) -> Array:
    """Cost of a step for the part of the heading that is against the way."""
    return AGAINST_M * np.maximum(-(np.cos(yaw) * along_x + np.sin(yaw) * along_y), 0.0)


def path_cost(
    task: PathCost, place: float, step_s: float, x_icr_m: float = 0.0, farthest_m: float = FARTHEST_STEP_M
) -> SequenceCost:
    """Cost of paths (T + 1, K) along way-points by arc length, from a place (entries of the table); see `PathCost`.

    Every step moves the place by its projection on the path's direction there, within the place's piece. The last
    heading is held against that of a robot that stays on the path.
    """
    path, table, count = task.path, task.path.table, len(task.path.table) - 1
    place, first, last = path.piece(place)
    endless = path.closed and not path.sharp_turns
    weight = max(1.0, STANDING_M / task.speed_m_s)

    piece = table[np.arange(int(first), int(last)) % count]
    along_rad = np.unwrap(np.arctan2(piece[:, 3], piece[:, 2]))
    rounded_m = SAME_X_ICR_M * round(x_icr_m / SAME_X_ICR_M)
    right = stable_yaw(along_rad, path.spacing_m, rounded_m, endless)

    def turned(at: Array) -> Array:
        """Heading (rad) of a robot on the path: half its angle to the piece has a tangent even from end to end."""
        index = np.minimum(at, last - 1.0).astype(int)
        along = along_rad[index - int(first)]
        begin, end = (np.clip(0.5 * (right[index - int(first) + i] - along), -1.3, 1.3) for i in (0, 1))
        return np.asarray(along + 2.0 * np.arctan(np.tan(begin) + (at - index) * (np.tan(end) - np.tan(begin))))

    def off(at: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Offset from the path's point at a place, and the path's direction there."""
        index = np.minimum(at, last - 1.0).astype(int)
        part = (at - index)[:, None]
        here, there = (table[i % count if path.closed else i] for i in (index, index + 1))
        off_x, off_y = (np.column_stack([x, y]) - (1.0 - part) * here[:, :2] - part * there[:, :2]).T
        return off_x, off_y, here[:, 2], here[:, 3]

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        at, total = np.full(x.shape[1], place), np.zeros(x.shape[1])
        for x_now, y_now, yaw_now, forward_now in zip(x[1:], y[1:], yaw[1:], forward, strict=True):
            off_x, off_y, along_x, along_y = off(at, x_now, y_now)
            along = np.clip(off_x * along_x + off_y * along_y, -farthest_m, farthest_m)
            target_m_s = np.full(at.shape, task.speed_m_s)
            if not endless:
                target_m_s = np.minimum(target_m_s, (last - at) * path.spacing_m / SLOW_DOWN_S)
            at = at + along / path.spacing_m
            at = np.mod(at, last) if endless else np.clip(at, first, last)
            off_x, off_y, along_x, along_y = off(at, x_now, y_now)
            missing = weight * (target_m_s - np.minimum(along / step_s, forward_now + target_m_s))
            total += np.hypot(np.hypot(off_x, off_y), missing) + facing_cost(yaw_now, along_x, along_y)
        swung = TURN_WEIGHT * abs(rounded_m) * turned_away(yaw[-1] - turned(at))
        return np.asarray(total + TERMINAL_M / (task.speed_m_s * step_s) * np.hypot(np.hypot(off_x, off_y), swung))

    return cost


def timed_path_cost(path: TimedPathCost, time_s: float, step_s: float) -> SequenceCost:
    """Cost of paths (T + 1, K) along way-points by time, which is `time_s` at the start; see `TimedPathCost`."""
    due_s = path.waypoints.times_s
    assert due_s is not None, "a path by time has times"

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        times = time_s + step_s * np.arange(len(x))
        there_x, there_y = (np.interp(times, due_s, column)[:, None] for column in path.waypoints.places_m.T)
        length = np.hypot(np.diff(there_x, axis=0), np.diff(there_y, axis=0))
        length = np.where(length < RESTS_M, np.inf, length)
        facing = facing_cost(yaw[1:], np.diff(there_x, axis=0) / length, np.diff(there_y, axis=0) / length)
        return np.asarray((np.hypot(x[1:] - there_x[1:], y[1:] - there_y[1:]) + facing).sum(axis=0))

    return cost
