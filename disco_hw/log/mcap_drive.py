"""A recorded log -> the arrays of a drive."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.config.input_file import parse_toml
from disco_hw.errors import InputError
from disco_hw.log.drive import Array, Commands, DriveLog, Gyro, Index, Poses, Wheels
from disco_hw.log.errors import LogError
from disco_hw.log.provenance import ROBOT_TOML
from disco_hw.log.reader import Log

Mask = NDArray[np.bool_]

_LARGEST_WHEEL_GAP_NS = 500_000_000


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
    pose_ns, pose = _samples(log, "/pose", ("x_m", "y_m", "yaw_rad"), notes)
    starts = [int(t_ns[0]) for t_ns in (command_ns, wheel_ns, pose_ns) if t_ns.size]
    if not starts:
        raise LogError(f"{log.path}: holds no command, wheel sample or pose; nothing was driven in it")
    breaks_ns = _breaks(log, wheel_ns, notes)

    def when(t_ns: Index) -> tuple[Array, Index]:
        seconds = (t_ns - min(starts)).astype(np.float64) * 1e-9
        return seconds, np.searchsorted(breaks_ns, t_ns, side="right").astype(np.int64)

    command_s, command_segment = when(command_ns)
    wheel_s, wheel_segment = when(wheel_ns)
    pose_s, pose_segment = when(pose_ns)
    left_angle, right_angle, left_speed, right_speed = wheel.T
    x_m, y_m, yaw_rad = pose.T
    measured = bool(wheel_s.size)
    return DriveLog(
        sources=(str(log.path),),
        commands=Commands(command_s, speeds[:, 0], speeds[:, 1], command_segment),
        wheels=Wheels(wheel_s, left_angle, right_angle, left_speed, right_speed, wheel_segment, measured, measured),
        poses=Poses(pose_s, x_m, y_m, yaw_rad, pose_segment),
        gyro=Gyro(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64)),
        notes=tuple(notes),
    )


def ticks_per_rev(log: Log) -> int | None:
    """Encoder ticks per wheel revolution from the configuration kept in the log, or None."""
    if ROBOT_TOML not in log.attachment_names():
        return None
    try:
        value = parse_toml(log.attachment(ROBOT_TOML), ROBOT_TOML)["robot"]["ticks_per_rev"]
    except (InputError, KeyError, TypeError):
        return None
    return value if isinstance(value, int) and value > 0 else None


def _columns(log: Log, topic: str) -> dict[str, NDArray[np.generic]]:
    """A topic whose ticks' times do not decrease."""
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


def _ordered(t_ns: NDArray[np.generic], values: Array, keep: Mask, what: str, notes: list[str]) -> tuple[Index, Array]:
    """In order of time, the first of several with one time; a sample may come in later than a newer one."""
    times = t_ns.astype(np.int64)[keep]
    unique, first = np.unique(times, return_index=True)
    if unique.size < times.size:
        notes.append(f"{times.size - unique.size} records of {what} have the time of another and were left out")
    return unique, values[keep][first]


def _breaks(log: Log, wheel_ns: Index, notes: list[str]) -> Index:
    """Times from which on a new segment counts."""
    gaps = log.gaps()
    if gaps:
        notes.append(f"{log.path}: {sum(gap.ticks for gap in gaps)} ticks are missing; each gap starts a new segment")
    silent = wheel_ns[1:][np.diff(wheel_ns) > _LARGEST_WHEEL_GAP_NS]
    missing = np.asarray([gap.before_ns for gap in gaps], dtype=np.int64)
    return np.unique(np.concatenate([silent, missing]))


def _floats(column: NDArray[np.generic]) -> Array:
    return column.astype(np.float64)
