"""Data that a log loses on import: counted by signal, reported with its share, and refused where most is lost.

Headings that nobody measured are lost as well: they stand still while the wheels turn the robot.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import LogError
from disco_hw.log.drive import LONGEST_COMMAND_S, Array, Commands, DriveLog, Poses, Wheels, chosen

WARNING = "warning: "
"""Notes that begin with this are printed before everything else."""
WARNED_SHARE, REFUSED_SHARE = 0.05, 0.5
"""Shares of a signal whose loss is a warning, and an error."""


def loss_note(source: str, signal: str, dropped: int, total: int, what: str, hint: str) -> str:
    """Return the sentence on `dropped` of `total` samples of a signal; `what` says what is wrong with them.

    It begins with WARNING if over 5 % of the signal is lost. Raises LogError if over half of it is.
    """
    share = dropped / total
    text = f"{source}: {signal}: {dropped} of {total} {what}"
    if share > REFUSED_SHARE:
        raise LogError(f"{text} ({_percent(share)}); {hint}")
    return share_note(text, share)


def share_note(text: str, share: float) -> str:
    """Return the sentence with the share of a signal that it speaks of; it begins with WARNING above 5 %."""
    return f"{WARNING if share > WARNED_SHARE else ''}{text} ({_percent(share)})"


# Chosen: above what the noise of an encoder makes of a wheel that stands.
_TURNING_RAD_S = 0.1


def unknown_commands_note(source: str, t_s: Array, commands: Commands, wheels: Wheels, why: str) -> tuple[str, ...]:
    """Return the sentence on the time for which no command is known, if there is any; `t_s`: the times of the log.

    Where the wheels were measured, only the time in which they turn counts.
    """
    if not np.isfinite(commands.left_rad_s).any():
        return ()
    counted = np.diff(t_s)
    text = ""
    if wheels.t_s.size:
        t_s, text = wheels.t_s, " in which the wheels turn"
        turning = np.maximum(np.abs(wheels.left_speed_rad_s), np.abs(wheels.right_speed_rad_s)) > _TURNING_RAD_S
        counted = np.minimum(np.diff(t_s), LONGEST_COMMAND_S) * (turning[:-1] & (np.diff(wheels.segment) == 0))
    known = np.append(np.isfinite(commands.left_rad_s), False)[np.searchsorted(commands.t_s, t_s[:-1], "right") - 1]
    unknown_s, of_s = float(counted[~known].sum()), float(counted.sum())
    if not unknown_s:
        return ()
    return (
        share_note(
            f"{source}: commands: none is known for {unknown_s:.1f} of {of_s:.1f} s{text}, {why}", unknown_s / of_s
        ),
    )


def warnings_first(notes: tuple[str, ...]) -> tuple[str, ...]:
    """Return the notes with the warnings ahead of the others, each kind in its order."""
    return tuple(sorted(notes, key=lambda note: not note.startswith(WARNING)))


def _percent(share: float) -> str:
    return "under 0.1 %" if share < 0.001 else f"{100.0 * share:.1f} %" if share < 0.1 else f"{100.0 * share:.0f} %"


# Chosen: so many equal headings in a row are no slower sensor.
_FEWEST_POSES = 10
_TURNED_RAD = 4.0
"""Difference of the wheels' angles while a heading stands still: half a radian or more of turning."""
# Below the last digit of any log: repeated, not measured.
_STATIONARY_RAD = 1e-9


def standing_headings(poses: Poses, wheels: Wheels) -> NDArray[np.bool_]:
    """Return which poses (N,) have a heading that stands still, to the last bit, while the wheels turn the robot.

    A source without heading writes one number all the time. Poses whose position stands still as well say nothing: the
    wheels may be off the ground.
    """
    standing = np.zeros(poses.t_s.size, dtype=bool)
    if poses.t_s.size < _FEWEST_POSES or wheels.t_s.size < 2:
        return standing
    turned = np.interp(poses.t_s, wheels.t_s, wheels.right_angle_rad - wheels.left_angle_rad)
    moves = ~(np.abs(np.diff(poses.yaw_rad)) <= _STATIONARY_RAD)
    moves |= np.diff(poses.segment) != 0
    ends = np.concatenate([[0], np.flatnonzero(moves) + 1, [poses.t_s.size]])
    for first, last in pairwise(ends.tolist()):
        part = slice(first, last)
        has_moved = np.ptp(poses.x_m[part]) > 0.0 or np.ptp(poses.y_m[part]) > 0.0
        if last - first >= _FEWEST_POSES and has_moved and np.ptp(turned[part]) > _TURNED_RAD:
            standing[part] = True
    return standing


def without_standing_headings(drive: DriveLog) -> DriveLog:
    """Return the drive with NaN for headings that nobody measured, and a note on them."""
    standing = standing_headings(drive.poses, drive.wheels)
    count = int(np.count_nonzero(standing))
    if not count:
        return drive
    note = (
        f"{WARNING}{', '.join(drive.sources)}: headings: {count} of {standing.size} stand still while the wheels turn "
        f"the robot ({100.0 * count / standing.size:.0f} %); the positions are kept, these headings are not"
    )
    poses = replace(drive.poses, yaw_rad=np.where(standing, np.nan, drive.poses.yaw_rad))
    return replace(drive, poses=poses, notes=(note, *drive.notes))


def with_headings_only(drive: DriveLog) -> DriveLog:
    """Return the drive without positions that have no heading, and a note on them; for whoever compares headings."""
    measured = np.isfinite(drive.poses.yaw_rad)
    if measured.all():
        return drive
    count = np.count_nonzero(~measured)
    note = (
        f"{WARNING}{', '.join(drive.sources)}: {count} of {measured.size} positions have no heading and were left out: "
        "what needs poses needs a source that measures the heading"
    )
    return replace(drive, poses=chosen(drive.poses, measured), notes=(note, *drive.notes))
