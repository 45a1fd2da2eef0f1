"""A logged drive as the simulations need it: wheel speeds on an even grid, and poses measured on it.

A run is a stretch of poses without a gap in which the wheels are known throughout; nothing is predicted across runs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError
from disco_hw.log.drive import Commands, DriveLog, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Source = Literal["encoders", "commands"]

STEP_S = 0.02
"""Step of the grid: 50 Hz, the rate of the shipped control loop."""
MOVING_RAD_S = 0.05
"""Wheels slower than this count as standing, so that what their encoders jitter is no motion."""
MOVING_SPREAD_STEPS = 5
"""A body counts as moving for so many steps before and after its wheels turn: it may lag behind them."""
# Chosen: of fewer, neither noise nor geometry can be told.
FEWEST_POSES = 50

# Longer gaps between wheel samples (s), or between poses (in median periods), leave the motion in between unknown.
_LONGEST_WHEEL_GAP_S = 0.6
_POSE_GAP_PERIODS = 6.0
_SHORTEST_RUN_S = 1.0
# About half a turn of the wheels; less is no drive.
_LEAST_ROLL_RAD = 3.0
# A pose that moves less than this for each radian that the wheels turn is not that of a robot on the ground.
_LEAST_PATH_RADIUS_M = 0.002


class UnusableDriveError(InputError):
    """A drive from which nothing can be inferred; the message is one line with the remedy."""


@dataclass(frozen=True, slots=True)
class Excitation:
    """Drive as inference uses it: the wheel speeds driven and the poses measured.

    Nodes (M,) of a grid of `step_s`: `wheel_rad_s` (M, 2) left and right, held from each node to the next; `moving`
    (M,) 1 while the wheels turn, else 0. Poses (P,): `pose` (P, 3) x, y (m), yaw (rad, not wrapped within a run) at
    `fraction` of a step after `node`; `roll_rad` (P, 2) mean and difference (right minus left) of the wheels' roll
    since the pose before, `moving_s` (P,) time in motion since then, all 0 for the first of a run. Run i holds nodes
    `run_node[i]` to `run_node[i + 1]` and poses `run_pose[i]` to `run_pose[i + 1]`.
    """

    source: Source
    step_s: float
    wheel_rad_s: Array
    moving: Array
    t_s: Array
    node: Index
    fraction: Array
    pose: Array
    roll_rad: Array
    moving_s: Array
    run_node: Index
    run_pose: Index
    notes: tuple[str, ...] = ()

    @property
    def duration_s(self) -> float:
        """Time covered by the runs."""
        return float(self.wheel_rad_s.shape[0] * self.step_s)

    @property
    def starts(self) -> NDArray[np.bool_]:
        """Mask (P,) of the poses that begin a run."""
        first = np.zeros(self.t_s.size, dtype=bool)
        first[self.run_pose[:-1]] = True
        return first


@dataclass(frozen=True, slots=True)
class _Roll:
    """Wheel angles (K, 2) at times (K,), straight in between; `unknown_s` (K,) is the unknown time before each."""

    t_s: Array
    angle_rad: Array
    unknown_s: Array


def excitation(log: DriveLog, source: Source | None = None) -> Excitation:
    """Lay a drive on the grid, driven by its measured wheels, or by its commands if none were measured or if told to.

    Raises UnusableDriveError if poses or wheels are missing, or nothing moved.
    """
    name = log.sources[0] if len(log.sources) == 1 else f"{len(log.sources)} logs"
    if log.poses.t_s.size < FEWEST_POSES:
        raise UnusableDriveError(
            f"{name}: {log.poses.t_s.size} poses, at least {FEWEST_POSES} are needed; "
            "record with a pose sensor (pose_x_m, pose_y_m, pose_yaw_rad)"
        )
    if source is None:
        source = "encoders" if log.wheels.t_s.size > 2 else "commands"
    runs = [run for segment in range(log.segments) for run in _runs(log, source, segment)]
    if not runs:
        raise UnusableDriveError(
            f"{name}: no period of {_SHORTEST_RUN_S:g} s in which both {source} and poses are known; record them "
            "together"
        )
    nodes = np.cumsum([0, *(run.wheel_rad_s.shape[0] for run in runs)])
    poses = np.cumsum([0, *(run.t_s.size for run in runs)])
    joined = Excitation(
        source,
        STEP_S,
        np.concatenate([run.wheel_rad_s for run in runs]),
        np.concatenate([run.moving for run in runs]),
        np.concatenate([run.t_s for run in runs]),
        np.concatenate([run.node + first for run, first in zip(runs, nodes[:-1], strict=True)]),
        np.concatenate([run.fraction for run in runs]),
        np.concatenate([run.pose for run in runs]),
        np.concatenate([run.roll_rad for run in runs]),
        np.concatenate([run.moving_s for run in runs]),
        nodes.astype(np.int64),
        poses.astype(np.int64),
        (*log.notes, *_left_out(log, source)),
    )
    _check_motion(name, joined)
    return joined


def _left_out(log: DriveLog, source: Source) -> list[str]:
    """Return a note where poses are ignored: the wheels beside them were not measured, those of others were."""
    if source == "commands":
        return []
    lacking = ~np.isin(log.poses.segment, log.wheels.segment)
    if not lacking.any():
        return []
    poses = np.count_nonzero(lacking)
    return [f"{poses} poses come without encoders and count for nothing beside those with them; infer their log alone"]


def _check_motion(name: str, drive: Excitation) -> None:
    if not (np.isfinite(drive.pose).all() and np.isfinite(drive.wheel_rad_s).all()):
        raise UnusableDriveError(f"{name}: a pose or wheel speed is not finite; leave out what was not measured")
    roll_rad = float(np.abs(drive.wheel_rad_s).max(axis=1).sum() * drive.step_s)
    if roll_rad < _LEAST_ROLL_RAD:
        raise UnusableDriveError(
            f"{name}: the wheels turn by {roll_rad:.2g} rad in all; record a drive of a minute or two"
        )
    displacement = drive.pose - np.repeat(drive.pose[drive.run_pose[:-1]], np.diff(drive.run_pose), axis=0)
    reach = float(np.hypot(displacement[:, 0], displacement[:, 1]).max() + 0.05 * np.abs(displacement[:, 2]).max())
    if reach < _LEAST_PATH_RADIUS_M * min(roll_rad, 50.0):
        raise UnusableDriveError(
            f"{name}: the wheels turn by {roll_rad:.3g} rad and the pose stays within {reach:.2g} m; "
            "the wheels are off the ground or the pose sensor is dead"
        )


def _runs(log: DriveLog, source: Source, segment: int) -> list[Excitation]:
    inside = log.poses.segment == segment
    if np.count_nonzero(inside) < 2:
        return []
    roll = _measured(log.wheels, segment) if source == "encoders" else _commanded(log.commands, segment)
    t_s = log.poses.t_s[inside]
    pose = np.column_stack([log.poses.x_m, log.poses.y_m, log.poses.yaw_rad])[inside]
    if roll.t_s.size < 2:
        return []
    covered = (t_s >= roll.t_s[0]) & (t_s <= roll.t_s[-1])
    t_s, pose = t_s[covered], pose[covered]
    if t_s.size < 2:
        return []
    unknown_s = np.interp(t_s, roll.t_s, roll.unknown_s)
    gap_s = np.diff(t_s)
    breaks = (gap_s > _POSE_GAP_PERIODS * np.median(gap_s)) | (np.diff(unknown_s) > 1e-9)
    edges = [0, *(np.flatnonzero(breaks) + 1).tolist(), t_s.size]
    return [
        _run(t_s[lo:hi], pose[lo:hi], roll, source)
        for lo, hi in pairwise(edges)
        if hi - lo > 2 and t_s[hi - 1] - t_s[lo] >= _SHORTEST_RUN_S
    ]


def _run(t_s: Array, pose: Array, roll: _Roll, source: Source) -> Excitation:
    steps = int((t_s[-1] - t_s[0]) / STEP_S) + 1
    grid = t_s[0] + STEP_S * np.arange(steps + 1)
    angle = _at(grid, roll)
    wheel_rad_s = np.diff(angle, axis=0) / STEP_S
    turning = (np.abs(wheel_rad_s).max(axis=1) > MOVING_RAD_S).astype(np.float64)
    moving = np.convolve(turning, np.ones(2 * MOVING_SPREAD_STEPS + 1), mode="same") > 0.0
    moved_s = np.concatenate([[0.0], np.cumsum(moving) * STEP_S])
    place = np.clip((t_s - t_s[0]) / STEP_S, 0.0, steps - 1e-9)
    at_pose = _at(t_s, roll)
    step_left, step_right = np.diff(at_pose, axis=0, prepend=at_pose[:1]).T
    node = np.floor(place).astype(np.int64)
    return Excitation(
        source,
        STEP_S,
        wheel_rad_s,
        moving.astype(np.float64),
        t_s,
        node,
        place - node,
        np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])]),
        np.column_stack([0.5 * (step_left + step_right), step_right - step_left]),
        np.diff(np.interp(t_s, grid, moved_s), prepend=0.0),
        np.array([0, steps]),
        np.array([0, t_s.size]),
    )


def _at(t_s: Array, roll: _Roll) -> Array:
    return np.column_stack([np.interp(t_s, roll.t_s, roll.angle_rad[:, side]) for side in (0, 1)])


def _measured(wheels: Wheels, segment: int) -> _Roll:
    inside = wheels.segment == segment
    t_s = wheels.t_s[inside]
    angle = np.column_stack([wheels.left_angle_rad[inside], wheels.right_angle_rad[inside]])
    gap_s = np.diff(t_s, prepend=t_s[:1])
    return _Roll(t_s, angle, np.cumsum(np.where(gap_s > _LONGEST_WHEEL_GAP_S, gap_s, 0.0)))


def _commanded(commands: Commands, segment: int) -> _Roll:
    inside = commands.segment == segment
    t_s = commands.t_s[inside]
    speed = np.column_stack([commands.left_rad_s[inside], commands.right_rad_s[inside]])
    if not t_s.size:
        return _Roll(t_s, np.empty((0, 2)), np.empty(0))
    known = np.isfinite(speed).all(axis=1)
    # The last command is in force for a while after it was given; how long is not in the log.
    t_s = np.append(t_s, t_s[-1] + _LONGEST_WHEEL_GAP_S)
    interval_s = np.diff(t_s)
    angle = np.cumsum(np.where(known[:, None], speed, 0.0) * interval_s[:, None], axis=0)
    unknown_s = np.cumsum(np.where(known, 0.0, interval_s))
    return _Roll(t_s, np.vstack([np.zeros(2), angle]), np.append(0.0, unknown_s))
