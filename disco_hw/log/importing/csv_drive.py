"""The CSV of logged drives <-> the arrays of a drive.

Header row, columns by name in any order: `t_s`, `cmd_left_rad_s`, `cmd_right_rad_s`, either `enc_*_rad_s` or
cumulative `enc_*_ticks` or both, `pose_x_m`, `pose_y_m`, `pose_yaw_rad`, optional `imu_wz_rad_s`, optional `segment`.
An empty cell is "no sample at that time". A log in degrees, millimetres or milliseconds is refused. What is written
has every float in the shortest form that reads back to the same bits.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import LogError
from disco_hw.files import DRIVE_CSV, read_lines
from disco_hw.log.drive import (
    Array,
    Commands,
    DriveLog,
    Gyro,
    Index,
    Poses,
    Wheels,
    differentiate_angle,
    integrate_angle,
)
from disco_hw.log.importing import LogFormat

_LONGEST_PERIOD_S = 2.0
_SHORTEST_PERIOD_S = 1e-4
_WHEEL_RADIUS_M = (0.005, 1.5)
_AGAINST_NOMINAL = 4.0
_STANDS_STILL = 100.0
_CHORD_ROLL_RAD = 2.0
_ENOUGH_CHORDS = 5
_LARGEST_TURN_RATIO = 3.0
_LARGEST_YAW_RATE_RAD_S = 6.0


def time_fault(t_s: Array) -> str | None:
    """What is wrong with times that should be in seconds, or None."""
    if t_s.size < 3:
        return None
    period_s = float(np.median(np.diff(t_s)))
    if _SHORTEST_PERIOD_S <= period_s <= _LONGEST_PERIOD_S:
        return None
    return f"t_s: {period_s:.3g} from row to row, which does not look like seconds; write seconds"


def yaw_fault(t_s: Array, yaw_rad: Array, segment: Index, wheels: Wheels, commands: Commands) -> str | None:
    """Whether yaw, as written in the file, looks like degrees: field, fault and remedy, or None.

    Yaw that stays within (-pi, pi] is taken as it is. Beyond, it may be radians that were not wrapped: they turn no
    more than the wheels can make them (yaw change <= difference of the wheels' roll x radius / axial distance).
    """
    if not yaw_rad.size or np.abs(yaw_rad).max() <= np.pi + 0.01:
        return None
    steps = np.diff(yaw_rad)
    usual = np.diff(segment) == 0
    turned = float(np.abs(steps[usual]).sum())
    _, roll = _roll(wheels, commands)
    if roll.size:
        possible = _LARGEST_TURN_RATIO * float(np.abs(np.diff(roll[:, 1] - roll[:, 0])).sum()) + np.pi
        degrees = turned > possible
    else:
        rate = np.abs(steps[usual] / np.diff(t_s)[usual])
        degrees = bool(rate.size) and float(np.quantile(rate, 0.9)) > _LARGEST_YAW_RATE_RAD_S
    if not degrees:
        return None
    return f"pose_yaw_rad: {turned:.0f} rad of turning is more than the wheels can do, like degrees; write radians"


def length_fault(poses: Poses, wheels: Wheels, commands: Commands, wheel_radius_m: float | None) -> str | None:
    """Whether path and roll of the wheels give an impossible wheel radius: field, fault and remedy, or None.

    The path is the sum of chords between poses that are 2 rad of forward roll apart, so that neither noise at rest nor
    turning on the spot counts. `wheel_radius_m` is the nominal radius if known; within a factor of 4 is believed.
    """
    roll_t_s, roll = _roll(wheels, commands)
    if poses.t_s.size < 2 or not roll.size:
        return None
    forward = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(roll.mean(axis=1))))))
    at_pose = np.interp(poses.t_s, roll_t_s, forward)
    _, picked = np.unique(np.floor(at_pose / _CHORD_ROLL_RAD), return_index=True)
    inside = np.diff(poses.segment[picked]) == 0
    if np.count_nonzero(inside) < _ENOUGH_CHORDS:
        return None
    path_m = float(np.hypot(np.diff(poses.x_m[picked]), np.diff(poses.y_m[picked]))[inside].sum())
    roll_rad = float(np.diff(at_pose[picked])[inside].sum())
    radius_m = path_m / roll_rad
    low, high = _WHEEL_RADIUS_M
    if wheel_radius_m is not None:
        low, high = wheel_radius_m / _AGAINST_NOMINAL, wheel_radius_m * _AGAINST_NOMINAL
    # Poses that do not move at all are lifted wheels or a dead sensor, not a unit.
    if low <= radius_m <= high or radius_m < low / _STANDS_STILL:
        return None
    fault = f"{path_m:.3g} m of path for {roll_rad:.3g} rad of wheel would be a wheel radius of {radius_m:.2g} m"
    return f"pose_x_m, pose_y_m against the wheels: {fault}; write metres, rad/s and the encoder's true ticks_per_rev"


def _roll(wheels: Wheels, commands: Commands) -> tuple[Array, Array]:
    """Times (N,) and cumulative wheel angles (N, 2), from the commands where no wheels were measured."""
    if wheels.t_s.size:
        return wheels.t_s, np.column_stack([wheels.left_angle_rad, wheels.right_angle_rad])
    t_s, segment = commands.t_s, commands.segment
    left, right = np.nan_to_num(commands.left_rad_s), np.nan_to_num(commands.right_rad_s)
    return t_s, np.column_stack([integrate_angle(t_s, left, segment), integrate_angle(t_s, right, segment)])


COMMAND = ("cmd_left_rad_s", "cmd_right_rad_s")
SPEED = ("enc_left_rad_s", "enc_right_rad_s")
TICKS = ("enc_left_ticks", "enc_right_ticks")
POSE = ("pose_x_m", "pose_y_m", "pose_yaw_rad")
GYRO = ("imu_wz_rad_s",)
TIME = "t_s"
SEGMENT = "segment"

Mask = NDArray[np.bool_]

_GROUPS = (COMMAND, SPEED, TICKS, POSE, GYRO)
_KNOWN = frozenset({TIME, SEGMENT, *(name for group in _GROUPS for name in group)})
_LONGEST_HOLD_S = 0.5
_LARGEST_STEP_REV = 10.0


class _Sheet(NamedTuple):
    """A file's columns: times (N,), segments (N,), and cells (N,) with NaN where they are empty."""

    name: str
    t_s: Array
    segment: Index
    cells: dict[str, Array]
    ignored: tuple[str, ...]


def read_csv(path: Path, ticks_per_rev: float | None = None, wheel_radius_m: float | None = None) -> DriveLog:
    """Read one CSV file; `ticks_per_rev` is needed for ticks, the nominal `wheel_radius_m` only sharpens the checks.

    A command holds through empty cells for half a second at most, after that it counts as unknown. Raises LogError with
    one line naming file, line, column and remedy: nothing in it, missing columns, cells that are no finite number, a
    clock that goes backwards, or units that cannot be.
    """
    sheet = _read(path)
    notes = [f"{path}: ignored columns: {', '.join(sheet.ignored)}"] if sheet.ignored else []
    t_s, segment = sheet.t_s, sheet.segment

    def refuse(fault: str | None) -> None:
        if fault is not None:
            raise LogError(f"{path}: {fault}")

    refuse(time_fault(t_s))
    commands = _commands(sheet)
    wheels = _wheels(sheet, ticks_per_rev)
    pose, there = _group(sheet, POSE)
    x_m, y_m, yaw_rad = pose[there].T
    refuse(yaw_fault(t_s[there], yaw_rad, segment[there], wheels, commands))
    poses = Poses(t_s[there], x_m, y_m, _wrapped(yaw_rad), segment[there])
    if not np.array_equal(poses.yaw_rad, yaw_rad):
        notes.append(f"{path}: pose_yaw_rad was wrapped to (-pi, pi]")
    refuse(length_fault(poses, wheels, commands, wheel_radius_m))
    rate, turning = _group(sheet, GYRO)
    gyro = Gyro(t_s[turning], rate[turning, 0], segment[turning])
    if not (np.isfinite(commands.left_rad_s).any() or wheels.t_s.size or poses.t_s.size):
        raise LogError(f"{path}: no row has a command, an encoder sample or a pose; nothing was driven in it")
    return DriveLog((str(path),), commands, wheels, poses, gyro, tuple(notes))


def _read(path: Path) -> _Sheet:
    reader = csv.reader(read_lines(path, DRIVE_CSV))
    try:
        header = [name.strip() for name in next(reader, [])]
        if not header:
            raise LogError(f"{path}: empty file; it needs a header row and samples")
        _check_header(path, header)
        lines, columns = _columns(path, header, reader)
    except csv.Error as error:
        raise LogError(f"{path}: not a CSV file ({error}); give an MCAP log or a CSV file") from None
    if not lines:
        raise LogError(f"{path}: a header and no rows; nothing was recorded in it")
    t_s = columns.pop(TIME)
    _check_clock(path, t_s, lines)
    segment = columns.pop(SEGMENT, np.zeros(t_s.size)).astype(np.int64)
    ignored = tuple(name for name in header if name not in _KNOWN)
    return _Sheet(str(path), t_s - t_s[0], segment, columns, ignored)


def _columns(path: Path, header: Sequence[str], rows: Iterator[list[str]]) -> tuple[Sequence[int], dict[str, Array]]:
    """The lines of the rows, and their known columns: NaN where a cell is empty, segments numbered from 0."""
    lines = array("q")
    columns = {name: array("d") for name in header if name in _KNOWN}
    places = [(header.index(name), name, column) for name, column in columns.items() if name != SEGMENT]
    segments, label_at = columns.get(SEGMENT), header.index(SEGMENT) if SEGMENT in header else 0
    label, number = "", 0
    for line, row in enumerate(rows, start=2):
        if not row:
            continue
        if len(row) != len(header):
            raise LogError(f"{path}: line {line}: {len(row)} cells under {len(header)} columns; mend that line")
        lines.append(line)
        for place, name, column in places:
            column.append(_number(path, line, name, row[place]))
        if segments is not None:
            # An empty cell continues the segment.
            given = row[label_at].strip()
            if given and given != label:
                number += bool(label)
                label = given
            segments.append(number)
    return lines, {name: np.array(column) for name, column in columns.items()}


def _check_header(path: Path, header: Sequence[str]) -> None:
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled:
        raise LogError(f"{path}: column {doubled[0]} is there twice; keep one")
    missing = [name for name in (TIME, *COMMAND) if name not in header]
    for group in (SPEED, TICKS, POSE):
        if any(name in header for name in group):
            missing += [name for name in group if name not in header]
    if missing:
        raise LogError(
            f"{path}: no column {', '.join(missing)}; the header must name t_s, {', '.join(COMMAND)} and pairs"
        )
    if not any(name in header for name in (*SPEED, *TICKS, *POSE)):
        raise LogError(f"{path}: neither encoder nor pose columns; add {', '.join(SPEED)} or {', '.join(POSE)}")


def _check_clock(path: Path, t_s: Array, lines: Sequence[int]) -> None:
    if np.isnan(t_s).any():
        raise LogError(f"{path}: line {lines[int(np.argmax(np.isnan(t_s)))]}: t_s is empty; every row needs its time")
    backwards = np.flatnonzero(np.diff(t_s) <= 0.0)
    if backwards.size:
        at = int(backwards[0])
        what = "stands still" if t_s[at + 1] == t_s[at] else "goes backwards"
        raise LogError(
            f"{path}: line {lines[at + 1]}: the clock {what} (t_s {t_s[at]:.9g}, then {t_s[at + 1]:.9g}); "
            "sort the rows, one for each time"
        )


def _number(path: Path, line: int, name: str, text: str) -> float:
    if not text.strip():
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LogError(
            f"{path}: line {line}: {name} is {text!r}, not a finite number; leave a cell without sample empty"
        )
    return value


def _commands(sheet: _Sheet) -> Commands:
    t_s = sheet.t_s
    values, given = _group(sheet, COMMAND)
    kept = given.copy()
    rows = np.flatnonzero(given)
    before = np.concatenate([np.zeros(1, dtype=bool), given[:-1]])
    for start in np.flatnonzero(~given & (before | (np.arange(t_s.size) == 0))):
        following = int(np.searchsorted(rows, start))
        holds = start > 0 and following < rows.size and t_s[rows[following]] - t_s[start - 1] <= _LONGEST_HOLD_S
        # One row of NaN says that from here on no command is known.
        kept[start] = not holds
    return Commands(t_s[kept], values[kept, 0], values[kept, 1], sheet.segment[kept])


def _wheels(sheet: _Sheet, ticks_per_rev: float | None) -> Wheels:
    speeds, has_speed = _group(sheet, SPEED)
    ticks, has_ticks = _group(sheet, TICKS)
    if not has_ticks.any():
        t_s, segment = sheet.t_s[has_speed], sheet.segment[has_speed]
        left, right = speeds[has_speed].T
        left_angle, right_angle = integrate_angle(t_s, left, segment), integrate_angle(t_s, right, segment)
        return Wheels(t_s, left_angle, right_angle, left, right, segment, False, bool(t_s.size))
    if ticks_per_rev is None:
        raise LogError(f"{sheet.name}: {TICKS[0]} needs the ticks of a revolution; give --robot ROBOT.toml")
    both = bool(has_speed.any())
    there = has_ticks & has_speed if both else has_ticks
    t_s, segment = sheet.t_s[there], sheet.segment[there]
    left_angle, right_angle = ticks[there].T * (2.0 * math.pi / ticks_per_rev)
    _check_angle(sheet.name, t_s, left_angle, segment)
    _check_angle(sheet.name, t_s, right_angle, segment)
    if both:
        left, right = speeds[there].T
    else:
        left, right = differentiate_angle(t_s, left_angle, segment), differentiate_angle(t_s, right_angle, segment)
    return Wheels(t_s, left_angle, right_angle, left, right, segment, True, both)


def _check_angle(name: str, t_s: Array, angle_rad: Array, segment: Index) -> None:
    jumps = (np.abs(np.diff(angle_rad)) > 2.0 * math.pi * _LARGEST_STEP_REV) & (np.diff(segment) == 0)
    if jumps.any():
        raise LogError(
            f"{name}: an encoder jumps by more than {_LARGEST_STEP_REV:.0f} revolutions at "
            f"t_s {t_s[1:][jumps][0]:.9g}; ticks must be cumulative and must not wrap"
        )


def _group(sheet: _Sheet, names: Sequence[str]) -> tuple[Array, Mask]:
    """The columns of a group side by side, (N, k), and where all of them have a value, (N,)."""
    empty = np.full(sheet.t_s.size, np.nan)
    values = np.column_stack([sheet.cells.get(name, empty) for name in names])
    there: Mask = np.isfinite(values).all(axis=1)
    return values, there


def _wrapped(yaw: Array) -> Array:
    wrapped = np.pi - np.mod(np.pi - yaw, 2.0 * np.pi)
    # What is in range already stays as it was, to the last bit.
    return np.where((yaw > -np.pi) & (yaw <= np.pi), yaw, wrapped)


# Last: any text may be meant as a table, and its reader says best what is wrong with it.
FORMAT = LogFormat(
    "csv",
    lambda begin: True,
    lambda path, config: read_csv(path, config.robot.ticks_per_rev, config.robot.wheel_radius_m),
    order=1000,
)


Cells = Callable[[float], list[str]]


def write_csv(drive: DriveLog, path: Path, ticks_per_rev: int | None) -> int:
    """Write one row for each time at which anything was recorded; return the number of rows.

    The command cells hold the command in force, and are empty where none is; the others are empty where there is no
    sample at that time. With `ticks_per_rev` the wheel angles are written as ticks. Raises LogError if the file exists
    or cannot be written.
    """
    wheels, poses = drive.wheels, drive.poses
    groups: list[tuple[tuple[str, ...], Cells]] = [
        (COMMAND, _in_force(drive)),
        (SPEED, _at(wheels.t_s, (wheels.left_speed_rad_s, wheels.right_speed_rad_s), repr)),
        (POSE, _at(poses.t_s, (poses.x_m, poses.y_m, poses.yaw_rad), repr)),
    ]
    if ticks_per_rev is not None and wheels.angle_measured:
        per_rad = ticks_per_rev / (2.0 * math.pi)
        ticks = (np.rint(wheels.left_angle_rad * per_rad), np.rint(wheels.right_angle_rad * per_rad))
        groups.insert(1, (TICKS, _at(wheels.t_s, ticks, lambda value: str(int(value)))))
    times, segments = _rows(drive)
    try:
        with path.open("x", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([TIME, *(name for names, _ in groups for name in names), SEGMENT])
            for t_s, segment in zip(times.tolist(), segments.tolist(), strict=True):
                writer.writerow([repr(t_s), *(cell for _, cells in groups for cell in cells(t_s)), segment])
    except FileExistsError:
        raise LogError(f"{path}: already exists; give another name") from None
    except OSError as error:
        # Half a table would pass for a whole one.
        path.unlink(missing_ok=True)
        raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
    return times.size


def _rows(drive: DriveLog) -> tuple[Array, Index]:
    """All times in order, and their segments."""
    parts = (drive.commands, drive.wheels, drive.poses)
    times, first = np.unique(np.concatenate([part.t_s for part in parts]), return_index=True)
    return times, np.concatenate([part.segment for part in parts])[first]


def _at(t_s: Array, columns: tuple[Array, ...], text: Callable[[float], str]) -> Cells:
    rows = dict(zip(t_s.tolist(), zip(*(column.tolist() for column in columns), strict=True), strict=True))
    nothing = [""] * len(columns)

    def cells(time: float) -> list[str]:
        values = rows.get(time)
        return nothing if values is None else [text(value) for value in values]

    return cells


def _in_force(drive: DriveLog) -> Cells:
    commands = drive.commands

    def cells(time: float) -> list[str]:
        at = int(np.searchsorted(commands.t_s, time, side="right")) - 1
        if at < 0 or math.isnan(commands.left_rad_s[at]):
            return ["", ""]
        return [repr(float(commands.left_rad_s[at])), repr(float(commands.right_rad_s[at]))]

    return cells
