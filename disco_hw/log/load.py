"""Loads drives from whatever they were recorded in: a log of ours, or a CSV."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, begin_of, parse_toml
from disco_hw.log import ROBOT_TOML
from disco_hw.log.container import MAGIC
from disco_hw.log.drive import Array, DriveLog, Index, after_silences, concatenate, drive_of
from disco_hw.log.importing.csv_drive import read_csv
from disco_hw.log.importing.losses import with_headings_only, without_standing_headings
from disco_hw.log.importing.rosbag_file import is_bag
from disco_hw.log.reader import Log, open_log

Mask = NDArray[np.bool_]


def drive_from_log(log: Log) -> DriveLog:
    """Commands as executed, wheel samples and measured poses of a log; time 0 is the first of them.

    Samples are put in order of their own time; a second one for the same time and measurements that are not finite are
    left out with a note. A new segment starts where ticks are missing and where wheel samples failed to come for half a
    second. Raises LogError if there is none of the three, if the ticks' clock goes backwards, and for damage.
    """
    notes: list[str] = []
    command = _columns(log, "/command")
    speeds = np.column_stack([_floats(command["left_rad_s"]), _floats(command["right_rad_s"])])
    speeds[~command["in_force"].astype(bool)] = np.nan
    command_ns, speeds = _ordered(command["t_ns"], speeds, np.ones(len(speeds), dtype=bool), "commands", notes)
    wheel_ns, wheel = _samples(
        log,
        "/wheels",
        ("left_angle_rad", "right_angle_rad", "left_speed_rad_s", "right_speed_rad_s"),
        notes,
    )
    pose_ns, pose = _poses(log, notes)
    if log.ending is not None and log.ending.continued:
        notes.append(f"{log.path}: was full, and goes on in the next part, which is a log of its own")
    if not (command_ns.size or wheel_ns.size or pose_ns.size):
        raise LogError(f"{log.path}: holds no command, wheel sample or pose; nothing was driven in it")
    breaks_ns = _breaks(log, wheel_ns, notes)
    drive = drive_of(str(log.path), (command_ns, speeds), (wheel_ns, wheel), (pose_ns, pose), breaks_ns, notes=notes)
    if not wheel_ns.size:
        return drive
    # What an import derived is in the log as it was derived.
    angle, speed = log.metadata.angle_measured, log.metadata.speed_measured
    return replace(drive, wheels=replace(drive.wheels, angle_measured=angle, speed_measured=speed))


def nominal_robot(log: Log) -> dict[str, float]:
    """Positive finite numbers of [robot] in the configuration kept in the log; empty without one."""
    if ROBOT_TOML not in log.attachment_names():
        return {}
    try:
        robot = parse_toml(log.attachment(ROBOT_TOML), ROBOT_TOML)["robot"]
        return {name: value for name, value in robot.items() if isinstance(value, int | float) and 0 < value < math.inf}
    except (InputError, KeyError, AttributeError):
        return {}


def _columns(log: Log, topic: str) -> dict[str, NDArray[np.generic]]:
    """Return a topic whose ticks' times do not decrease."""
    columns = log.columns(topic)
    now_ns = columns["now_ns"].astype(np.int64)
    back = np.flatnonzero(np.diff(now_ns) < 0)
    if back.size:
        at_s = (now_ns[back[0]] - now_ns[0]) * 1e-9
        by_s = (now_ns[back[0]] - now_ns[back[0] + 1]) * 1e-9
        raise LogError(
            f"{log.path}: the clock goes backwards by {by_s:.3g} s after {at_s:.3g} s of {topic}; "
            "give each run as a log of its own"
        )
    return columns


def _samples(log: Log, topic: str, names: tuple[str, ...], notes: list[str]) -> tuple[Index, Array]:
    columns = _columns(log, topic)
    values = np.column_stack([_floats(columns[name]) for name in names])
    finite = np.asarray(np.isfinite(values).all(axis=1))
    if not finite.all():
        notes.append(f"{log.path}: {np.count_nonzero(~finite)} records of {topic} are not finite and were left out")
    return _ordered(columns["t_ns"], values, finite, topic, notes)


def _poses(log: Log, notes: list[str]) -> tuple[Index, Array]:
    """Poses with a heading: whoever takes a drive as arrays compares headings."""
    columns = _columns(log, "/pose")
    values = np.column_stack([_floats(columns[name]) for name in ("x_m", "y_m", "yaw_rad")])
    bare = np.isnan(values[:, 2]) & np.isnan(_floats(columns["yaw_std_rad"])) & np.isfinite(values[:, :2]).all(axis=1)
    finite = np.asarray(np.isfinite(values).all(axis=1))
    source = columns["source"].astype(np.int64)
    counts = np.bincount(source[finite]) if finite.any() else np.zeros(1, dtype=np.int64)
    if np.count_nonzero(counts) > 1:
        # Each has an error of its own that lasts: from one to the other is no motion.
        kept = finite & (source == int(counts.argmax()))
        notes.append(
            f"{log.path}: poses of several sources; those of the one with most, number {int(counts.argmax())} of "
            f"[pose], are used, {np.count_nonzero(finite & ~kept)} others left out"
        )
    else:
        kept = finite
    if bare.any():
        notes.append(
            f"{log.path}: {np.count_nonzero(bare)} positions without heading were left out: what needs poses needs "
            "a source that measures the heading"
        )
    if not (finite | bare).all():
        notes.append(
            f"{log.path}: {np.count_nonzero(~(finite | bare))} records of /pose are not finite and were left out"
        )
    return _ordered(columns["t_ns"], values, kept, "/pose", notes)


def _ordered(t_ns: NDArray[np.generic], values: Array, keep: Mask, what: str, notes: list[str]) -> tuple[Index, Array]:
    """Sort samples by time and keep the first of several with one time. Samples may arrive out of order."""
    times = t_ns.astype(np.int64)[keep]
    unique, first = np.unique(times, return_index=True)
    if unique.size < times.size:
        notes.append(f"{times.size - unique.size} records of {what} have the time of another and were left out")
    return unique, values[keep][first]


def _breaks(log: Log, wheel_ns: Index, notes: list[str]) -> Index:
    """Return times from which on a new segment counts."""
    gaps = log.gaps()
    missing = sum(gap.ticks for gap in gaps) - len(gaps) * log.is_import
    if missing:
        notes.append(f"{log.path}: {missing} ticks are missing; each gap starts a new segment")
    after_gaps = np.asarray([gap.before_ns for gap in gaps], dtype=np.int64)
    return np.unique(np.concatenate([after_silences(wheel_ns), after_gaps]))


def _floats(column: NDArray[np.generic]) -> Array:
    return column.astype(np.float64)


# Chosen: fewer equal poses, or a smaller share of them, may be chance in short logs.
_FEWEST_POSES = 20
_COPIED_SHARE = 0.5


def load_drive(
    paths: Path | str | Sequence[Path | str],
    ticks_per_rev: float | None = None,
    wheel_radius_m: float | None = None,
) -> DriveLog:
    """One log or several as one drive: our MCAP logs and CSV files, recognised by their content.

    `ticks_per_rev` and the nominal `wheel_radius_m` come from robot.toml and serve CSV files only. Raises LogError with
    one line for the first file that cannot be used, or that is there already.
    """
    several = [Path(path) for path in ([paths] if isinstance(paths, Path | str) else paths)]
    if not several:
        raise LogError("no log given; give at least one")
    for place, path in enumerate(several):
        if os.path.realpath(path) in map(os.path.realpath, several[:place]):
            raise LogError(f"{path}: given twice, so that its data would count twice; give each log once")
    drives = [_load(path, ticks_per_rev, wheel_radius_m) for path in several]
    if len(drives) > 1:
        _refuse_copies(several, [_marks(drive) for drive in drives])
    return concatenate(drives)


def _refuse_copies(paths: Sequence[Path], marks: Sequence[set[tuple[float, ...]]]) -> None:
    """Raise LogError for a log and its recovered, exported or imported copy: they are one drive under two names."""
    for place, path in enumerate(paths):
        for other, theirs in zip(paths[:place], marks[:place], strict=True):
            fewest = min(len(marks[place]), len(theirs))
            if fewest >= _FEWEST_POSES and len(marks[place] & theirs) > _COPIED_SHARE * fewest:
                raise LogError(f"{path}: holds the same data as {other}, which would count twice; give one of them")


def _marks(drive: DriveLog) -> set[tuple[float, ...]]:
    """Return the different measured poses, each with the time since the one before (us), as no other drive has them."""
    poses = drive.poses
    since_us = np.rint(np.diff(poses.t_s) * 1e6)
    columns = (since_us, poses.x_m[1:], poses.y_m[1:], poses.yaw_rad[1:])
    return set(zip(*(column.tolist() for column in columns), strict=True))


def _load(path: Path, ticks_per_rev: float | None, wheel_radius_m: float | None) -> DriveLog:
    begin = begin_of(path, LOG, 64)
    if is_bag(begin):
        raise LogError(f"{path}: a rosbag; make it a log with `disco-hw import {path} --robot ROBOT.toml -o LOG.mcap`")
    if begin.startswith(MAGIC):
        with open_log(path) as log:
            return drive_from_log(log)
    drive = without_standing_headings(read_csv(path, ticks_per_rev, wheel_radius_m))
    return with_headings_only(drive)
