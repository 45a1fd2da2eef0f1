"""Increments of commands, wheels and poses over windows of one second, side by side.

They are what a contradiction between the three shows in before any model is fitted. Windows lie where wheels were
measured and overlap by three quarters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import Array, Commands, DriveLog

WINDOW_S = 1.0
STEP_S = 0.25
_LONGEST_GAP_S = 0.6
_LEAST_GAP_S = 1e-9

Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class MotionWindows:
    """Motion within each window of a log: `t_s` (W,) where it begins, and increments, NaN where they are not known.

    `commanded_rad`, `rolled_rad` (W, 2) left and right wheel; `moved_m` (W,) displacement in the world as complex
    x + iy; `heading_rad` (W,) at the middle; `turned_rad` (W,) change of the heading.
    """

    t_s: Array
    commanded_rad: Array
    rolled_rad: Array
    moved_m: NDArray[np.complex128]
    heading_rad: Array
    turned_rad: Array


def motion_windows(log: DriveLog, poses_rate: float = 1.0) -> MotionWindows:
    """Cut a drive into windows; poses count at `poses_rate` times their own time."""
    parts = [_of_segment(log, segment, poses_rate) for segment in range(log.segments)]
    parts = [part for part in parts if part.t_s.size]
    if not parts:
        nothing, pairs = np.empty(0), np.empty((0, 2))
        return MotionWindows(nothing, pairs, pairs, np.empty(0, dtype=np.complex128), nothing, nothing)
    return MotionWindows(*(np.concatenate([getattr(part, name) for part in parts]) for name in MotionWindows.__slots__))


def _of_segment(log: DriveLog, segment: int, poses_rate: float) -> MotionWindows:
    commands, wheels, poses = log.commands, log.wheels, log.poses
    told: Mask = np.asarray(commands.segment == segment)
    rolling, seen = wheels.segment == segment, poses.segment == segment
    pose_s = poses_rate * poses.t_s[seen]
    rolled_s = wheels.t_s[rolling]
    begin = np.arange(rolled_s[0], rolled_s[-1] - WINDOW_S, STEP_S) if rolled_s.size else rolled_s
    angle = np.column_stack([wheels.left_angle_rad[rolling], wheels.right_angle_rad[rolling]])
    yaw = np.unwrap(poses.yaw_rad[seen])
    place = np.column_stack([poses.x_m[seen], poses.y_m[seen], yaw])
    moved = _increments(pose_s, place, _gaps(pose_s), begin)
    return MotionWindows(
        begin,
        _increments(*_integrated(commands, told), begin),
        _increments(rolled_s, angle, _gaps(rolled_s), begin),
        moved[:, 0] + 1j * moved[:, 1],
        np.interp(begin + 0.5 * WINDOW_S, pose_s, yaw) if yaw.size else np.full(begin.size, np.nan),
        moved[:, 2],
    )


def _integrated(commands: Commands, inside: Mask) -> tuple[Array, Array, Array]:
    """Return times (N,), the commands' integral (N, 2), each held until the next, and the time without any (N,)."""
    t_s = commands.t_s[inside]
    if not t_s.size:
        return t_s, np.empty((0, 2)), t_s
    # The last command is in force for a while after it was given; how long is not in the log.
    t_s = np.append(t_s, t_s[-1] + _LONGEST_GAP_S)
    speed = np.column_stack([commands.left_rad_s[inside], commands.right_rad_s[inside]])
    known: Mask = np.asarray(np.isfinite(speed).all(axis=1))
    held_s = np.diff(t_s)
    angle = np.cumsum(np.where(known[:, None], speed, 0.0) * held_s[:, None], axis=0)
    return t_s, np.vstack([np.zeros(2), angle]), np.append(0.0, np.cumsum(np.where(known, 0.0, held_s)))


def _gaps(t_s: Array) -> Array:
    """Total length of the gaps before each sample (N,), s: time in which nothing is known."""
    gap_s = np.diff(t_s, prepend=t_s[:1])
    return np.cumsum(np.where(gap_s > _LONGEST_GAP_S, gap_s, 0.0))


def _increments(t_s: Array, values: Array, lost_s: Array, begin: Array) -> Array:
    """Change of each column of `values` (N, k) over the windows (W, k); NaN where `lost_s` (N,) grows within one."""
    if t_s.size < 2:
        return np.full((begin.size, values.shape[1]), np.nan)
    end = begin + WINDOW_S
    columns = [np.interp(end, t_s, column) - np.interp(begin, t_s, column) for column in values.T]
    lost = np.interp(end, t_s, lost_s) - np.interp(begin, t_s, lost_s)
    known: Mask = np.asarray((begin >= t_s[0]) & (end <= t_s[-1]) & (lost < _LEAST_GAP_S))
    return np.where(known[:, None], np.column_stack(columns), np.nan)
