"""Read and write CSV logs of drives, with checks of units and unwrapping of encoder ticks.

Header row, columns by name in any order: `t_s`, `cmd_left_rad_s`, `cmd_right_rad_s`, either `enc_*_rad_s` or
cumulative `enc_*_ticks` or both, `pose_x_m`, `pose_y_m`, `pose_yaw_rad`, optional `imu_wz_rad_s`, optional `segment`.
An empty cell is "no sample at that time"; `pose_yaw_rad` may be left out. A log in degrees,
millimetres or milliseconds is refused. What is written has every float in the shortest form that reads back to the same
bits.
"""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import LogError
from disco_hw.log.drive import (
    LONGEST_COMMAND_S,
    Array,
    Commands,
    DriveLog,
    Gyro,
    Index,
    Poses,
    Wheels,
    differentiate_angle,
    integrate_angle,
    with_unknown,
)
from disco_hw.log.importing import LogFormat
from disco_hw.log.importing.counter_wrap import Mask, continuous_wheels, restarts
from disco_hw.log.importing.csv_sheet import (
    COMMAND,
    GYRO,
    POSITION,
    SEGMENT,
    SIGNALS,
    SPEED,
    TICKS,
    TIME,
    YAW,
    Sheet,
    read_sheet,
)
from disco_hw.log.importing.losses import share_note, unknown_commands_note, warnings_first

# Chosen: a median from sample to sample outside these is milliseconds or nanoseconds read as seconds.
_LONGEST_PERIOD_S = 1.0
# Chosen: longer than a slow receiver's, where positions are all that was measured; milliseconds are further apart.
_LONGEST_POSITION_PERIOD_S = 10.0
_SHORTEST_PERIOD_S = 1e-4
# Chosen: of any robot's wheels; a factor of 10 or more from wrong units leaves this range, or that around the nominal
# radius.
_WHEEL_RADIUS_M = (0.005, 1.5)
_AGAINST_NOMINAL = 4.0
# Chosen: poses that move so many times less than the wheels do not move at all.
_STATIONARY_COUNTS = 100.0
# Chosen: chords this long are far above a pose's noise and little shorter than their arcs; fewer say too little.
_CHORD_ROLL_RAD = 2.0
_ENOUGH_CHORDS = 5
# Chosen: no robot turns so many times further, or faster, than this; degrees read as radians do.
_LARGEST_TURN_RATIO = 3.0
_LARGEST_YAW_RATE_RAD_S = 6.0


def time_fault(t_s: Array, longest_s: float = _LONGEST_PERIOD_S) -> str | None:
    """Describe the error in times of a signal that should be in seconds; None if there is none."""
    if t_s.size < 3:
        return None
    period_s = float(np.median(np.diff(t_s)))
    if _SHORTEST_PERIOD_S <= period_s <= longest_s:
        return None
    return f"t_s: {period_s:.3g} from sample to sample, which does not look like seconds; write seconds"


def yaw_fault(t_s: Array, yaw_rad: Array, segment: Index, wheels: Wheels, commands: Commands) -> str | None:
    """Return field, fault and hint if yaw, as written in the file, looks like degrees; None otherwise.

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
    """Return field, fault and hint if path and wheel rotation give an impossible wheel radius; None otherwise.

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
    if low <= radius_m <= high or radius_m < low / _STATIONARY_COUNTS:
        return None
    fault = f"{path_m:.3g} m of path for {roll_rad:.3g} rad of wheel would be a wheel radius of {radius_m:.2g} m"
    return f"pose_x_m, pose_y_m against the wheels: {fault}; write metres, rad/s and the encoder's true ticks_per_rev"


def _roll(wheels: Wheels, commands: Commands) -> tuple[Array, Array]:
    """Return times (N,) and cumulative wheel angles (N, 2), from the commands where no wheels were measured."""
    if wheels.t_s.size:
        return wheels.t_s, np.column_stack([wheels.left_angle_rad, wheels.right_angle_rad])
    t_s, segment = commands.t_s, commands.segment
    left, right = np.nan_to_num(commands.left_rad_s), np.nan_to_num(commands.right_rad_s)
    return t_s, np.column_stack([integrate_angle(t_s, left, segment), integrate_angle(t_s, right, segment)])


# Chosen: an encoder that begins anew oftener is not one, but a column that is none.
_MAX_RESTART_SHARE = 0.05


def read_csv(path: Path, ticks_per_rev: float | None = None, wheel_radius_m: float | None = None) -> DriveLog:
    """Read one CSV file; `ticks_per_rev` is needed for ticks, the nominal `wheel_radius_m` only sharpens the checks.

    A command holds through empty cells for half a second at most, see `_commands`. Ticks that wrap are
    made continuous, and where an encoder was set anew a new segment begins. A position without heading has NaN for its
    yaw. Raises LogError with one line naming file, line, column and remedy: nothing in it, missing columns, a signal of
    which over half cannot be read, a clock that goes back, ticks that wrap faster than they are read, or units that
    cannot be.
    """
    sheet = read_sheet(path)
    notes: list[str] = []

    def refuse(fault: str | None) -> None:
        if fault is not None:
            raise LogError(f"{path}: {fault}")

    # Rows of several signals may alternate, with the command in force in each: what was measured most shows the unit.
    samples = {names: sheet.group(names)[1] for names in SIGNALS.values() if names != COMMAND}
    has_wheels = samples[SPEED].any() or samples[TICKS].any()
    longest_s = _LONGEST_PERIOD_S if has_wheels else _LONGEST_POSITION_PERIOD_S
    refuse(time_fault(sheet.t_s[max(samples.values(), key=np.count_nonzero)], longest_s))
    sheet, wheels = _wheels(sheet, ticks_per_rev, notes)
    t_s, segment = sheet.t_s, sheet.segment
    commands = _commands(sheet, wheels, notes)
    position, there = sheet.group(POSITION)
    x_m, y_m = position[there].T
    yaw_rad = sheet.group((YAW,))[0][there, 0]
    measured = np.isfinite(yaw_rad)
    refuse(yaw_fault(t_s[there][measured], yaw_rad[measured], segment[there][measured], wheels, commands))
    poses = Poses(t_s[there], x_m, y_m, _wrapped(yaw_rad), segment[there])
    if not np.array_equal(poses.yaw_rad, yaw_rad, equal_nan=True):
        notes.append(f"{path}: {YAW} was wrapped to (-pi, pi]")
    refuse(length_fault(poses, wheels, commands, wheel_radius_m))
    rate, turning = sheet.group(GYRO)
    gyro = Gyro(t_s[turning], rate[turning, 0], segment[turning])
    if not (np.isfinite(commands.left_rad_s).any() or wheels.t_s.size or poses.t_s.size):
        raise LogError(f"{path}: no row has a command, an encoder sample or a pose; nothing was driven in it")
    notes_first = warnings_first((*sheet.notes, *notes))
    return DriveLog((str(path),), commands, wheels, poses, gyro, notes_first, began_ns=round(sheet.begin_s * 1e9))


def _commands(sheet: Sheet, wheels: Wheels, notes: list[str]) -> Commands:
    """Commands, with a row of NaN where from then on none is known.

    A file with a command in most rows writes what is in force: over half a second of empty cells says that nothing is.
    Where most commands have an empty cell behind them, they are written on change or in rows of their own: each counts
    for half a second at most, as for the controllers of ROS.
    """
    t_s = sheet.t_s
    values, given = sheet.group(COMMAND)
    rows = np.flatnonzero(given)
    next_s = np.append(t_s[rows], np.inf)[1:]
    ends = np.append(~given[1:], False)[rows]
    expires = ends & (next_s - t_s[rows] > LONGEST_COMMAND_S)
    on_change = 2 * np.count_nonzero(ends) > rows.size
    if on_change:
        end_s = t_s[rows[expires]] + LONGEST_COMMAND_S
        unknown_s = float(np.maximum(np.minimum(next_s[expires], t_s[-1]) - end_s, 0.0).sum())
        of_s = float(t_s[-1] - t_s[rows[0]])
        if unknown_s > 0.0:
            text = (
                f"{sheet.name}: commands: most have an empty cell behind them and count for {LONGEST_COMMAND_S:g} s at "
                f"most; write the one in force into every row, as none is known for {unknown_s:.1f} of {of_s:.1f} s"
            )
            notes.append(share_note(text, unknown_s / of_s))
    else:
        end_s = t_s[rows[expires] + 1]
    unknown_from_s = np.concatenate([t_s[:1][~given[:1]], end_s[end_s <= t_s[-1]]])
    times_s, speeds = with_unknown(t_s[rows], values[rows], unknown_from_s)
    segment = sheet.segment[np.searchsorted(t_s, times_s, side="right") - 1]
    commands = Commands(times_s, speeds[:, 0], speeds[:, 1], segment)
    if not on_change:
        why = f"as its cells are empty for over {LONGEST_COMMAND_S:g} s; write one that is in force into every row"
        notes += unknown_commands_note(sheet.name, t_s, commands, wheels, why)
    return commands


def _wheels(sheet: Sheet, ticks_per_rev: float | None, notes: list[str]) -> tuple[Sheet, Wheels]:
    """Wheel samples, and the sheet with new segments where an encoder was set anew."""
    speeds, has_speed = sheet.group(SPEED)
    ticks, has_ticks = sheet.group(TICKS)
    if not has_ticks.any():
        t_s, segment = sheet.t_s[has_speed], sheet.segment[has_speed]
        left, right = speeds[has_speed].T
        left_angle, right_angle = integrate_angle(t_s, left, segment), integrate_angle(t_s, right, segment)
        return sheet, Wheels(t_s, left_angle, right_angle, left, right, segment, False, bool(t_s.size))
    if ticks_per_rev is None:
        raise LogError(
            f"{sheet.name}: {TICKS[0]} needs the ticks of a revolution; give ticks_per_rev (--robot ROBOT.toml on the "
            "command line)"
        )
    t_s = sheet.t_s[has_ticks]
    per_rad = ticks_per_rev / (2.0 * math.pi)
    begins = np.concatenate([[True], np.diff(sheet.segment[has_ticks]) != 0])
    measured, commanded = (sheet.group(names)[0][has_ticks] * per_rad for names in (SPEED, COMMAND))
    known = np.where(np.isfinite(measured), measured, commanded)
    names = (f"{sheet.name}: {TICKS[0]}", f"{sheet.name}: {TICKS[1]}")
    counts, uncertain = continuous_wheels(names, t_s, ticks[has_ticks], (ticks_per_rev,), begins, known, notes)
    angles = counts * (2.0 * math.pi / ticks_per_rev)
    sheet = _with_new_segments(sheet, t_s, angles, uncertain, sheet.segment[has_ticks], notes)
    segment = sheet.segment[has_ticks]
    derived = np.column_stack([differentiate_angle(t_s, column, segment) for column in angles.T])
    there = has_speed[has_ticks]
    # Where the speeds are rare they say less than the ticks do.
    both = bool(2 * np.count_nonzero(there) > there.size)
    left, right = np.where(there[:, np.newaxis] & both, speeds[has_ticks], derived).T
    if has_speed.any() and not (both and there.all()):
        count = int(np.count_nonzero(~there) if both else there.size)
        notes.append(f"{sheet.name}: {SPEED[0]}: {count} of {there.size} speeds were taken from the ticks")
    return sheet, Wheels(t_s, angles[:, 0], angles[:, 1], left, right, segment, True, both)


def _with_new_segments(
    sheet: Sheet, t_s: Array, angles: Array, uncertain: Mask, segment: Index, notes: list[str]
) -> Sheet:
    """Return the sheet with a new segment wherever an encoder restarts or may have wrapped."""
    inside = np.concatenate([[False], np.diff(segment) == 0])
    restart, uncertain = restarts(t_s, angles) & ~uncertain & inside, uncertain & inside

    def first(which: Mask) -> str:
        # Digits enough for seconds since 1970.
        return f"first at t_s {sheet.begin_s + t_s[which][0]:.15g}"

    if np.count_nonzero(restart) > _MAX_RESTART_SHARE * t_s.size:
        raise LogError(
            f"{sheet.name}: an encoder jumps {np.count_nonzero(restart)} times, {first(restart)}, "
            f"further than a wheel turns; {TICKS[0]} and {TICKS[1]} must be cumulative, and ticks_per_rev the true one"
        )
    for which, what in (
        (restart, "an encoder was reset"),
        (uncertain, "ticks are missing for so long that they may have wrapped unseen,"),
    ):
        if which.any():
            times = f"{np.count_nonzero(which)} times, {first(which)}"
            notes.append(f"{sheet.name}: {what} {times}; new segments begin there")
    breaks_s = t_s[restart | uncertain]
    return replace(sheet, segment=sheet.segment + np.searchsorted(breaks_s, sheet.t_s, side="right"))


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


def write_csv(drive: DriveLog, path: Path, ticks_per_rev: float | None) -> int:
    """Write one row for each time at which anything was recorded; return the number of rows.

    The command cells hold the command in force, and are empty where none is; the others are empty where there is no
    sample at that time. With `ticks_per_rev` measured wheel angles are written as ticks, and speeds only if they were
    measured. Raises LogError if the file exists or cannot be written.
    """
    commands, wheels, poses = drive.commands, drive.wheels, drive.poses
    parts = (commands, wheels, poses)
    times, first = np.unique(np.concatenate([part.t_s for part in parts]), return_index=True)
    segments = np.concatenate([part.segment for part in parts])[first]
    last_command = np.searchsorted(commands.t_s, times, side="right") - 1
    in_force = np.vstack([np.column_stack([commands.left_rad_s, commands.right_rad_s]), [np.nan, np.nan]])[last_command]
    in_force[np.isnan(in_force).any(axis=1)] = np.nan
    table = dict(zip(COMMAND, ([_cell(value) for value in column] for column in in_force.T.tolist()), strict=True))
    if ticks_per_rev is not None and wheels.angle_measured:
        per_rad = ticks_per_rev / (2.0 * math.pi)
        for name, angle_rad in zip(TICKS, (wheels.left_angle_rad, wheels.right_angle_rad), strict=True):
            table[name] = _cells(times, wheels.t_s, np.rint(angle_rad * per_rad).astype(np.int64))
    if wheels.speed_measured or TICKS[0] not in table:
        for name, speed_rad_s in zip(SPEED, (wheels.left_speed_rad_s, wheels.right_speed_rad_s), strict=True):
            table[name] = _cells(times, wheels.t_s, speed_rad_s)
    for name, value in zip((*POSITION, YAW), (poses.x_m, poses.y_m, poses.yaw_rad), strict=True):
        table[name] = _cells(times, poses.t_s, value)
    try:
        file = path.open("x", newline="", encoding="utf-8")
    except FileExistsError:
        raise LogError(f"{path}: already exists; give another name") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
    try:
        with file:
            writer = csv.writer(file)
            writer.writerow([TIME, *table, SEGMENT])
            writer.writerows(zip(map(repr, times.tolist()), *table.values(), segments.tolist(), strict=True))
    except BaseException as error:
        # Half a table would pass for a whole one.
        path.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise LogError(f"{path}: cannot be written ({error.strerror}); give another place") from None
        raise
    return times.size


def _cells(times: Array, t_s: Array, values: NDArray[Any]) -> list[str]:
    """Return a column of the table: the samples at exactly these times, empty where there is none."""
    cells = [""] * times.size
    for place, value in zip(np.searchsorted(times, t_s).tolist(), values.tolist(), strict=True):
        cells[place] = repr(value)
    return cells


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(value)
