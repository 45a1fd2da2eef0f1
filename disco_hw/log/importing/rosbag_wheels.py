"""The wheels of a bag: which of positions and velocities were measured, and positions that wrap made continuous."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from disco_hw.config import Robot
from disco_hw.errors import LogError
from disco_hw.log.drive import LONGEST_SILENCE_NS, Array, Index
from disco_hw.log.importing.counter_wrap import WIDTHS_BITS, Mask, continuous_wheels
from disco_hw.log.importing.losses import loss_note
from disco_hw.log.importing.rosbag_topics import WHEELS


def measured_columns(path: Path, t_ns: Index, wheel: Array, notes: list[str]) -> tuple[Index, Array, tuple[bool, bool]]:
    """Rows in which everything is there that the wheels measure at all, and whether that is angles, and speeds."""
    angles, speeds = (np.isfinite(wheel[:, part]).all(axis=1) for part in (slice(0, 2), slice(2, 4)))
    has_angle, has_speed = (
        bool(2 * np.count_nonzero(angles) > t_ns.size),
        bool(2 * np.count_nonzero(speeds) > t_ns.size),
    )
    kept = (angles | (not has_angle)) & (speeds | (not has_speed))
    if t_ns.size and not (has_angle or has_speed):
        raise LogError(
            f"{path}: wheels: most messages have neither position nor velocity of all wheels; "
            "set ros2.left_joints and ros2.right_joints"
        )
    if not kept.all():
        dropped, what = int(np.count_nonzero(~kept)), "messages lack a position or velocity and were left out"
        notes.append(
            loss_note(str(path), WHEELS, dropped, kept.size, what, "set ros2.left_joints and ros2.right_joints")
        )
    wheel = wheel[kept]
    if has_angle and has_speed and (wheel[:, 2:] == 0.0).all() and np.ptp(wheel[:, 0]) > 1.0:
        notes.append("wheels: the velocities are all zero while the wheels turn; they were taken from the positions")
        has_speed = False
    return t_ns[kept], wheel, (has_angle, has_speed)


def unwrapped(
    path: Path, t_ns: Index, wheel: Array, robot: Robot, commands: tuple[Index, Array], notes: list[str]
) -> tuple[Array, Mask]:
    """Wheels whose angles are continuous; and where the number of wraps is not known, (N,).

    Angles wrap at a turn or where the counter behind them overflows; each wheel is judged by itself.
    """
    # Before the first command nothing is known.
    commanded = np.vstack([[np.nan, np.nan], commands[1]])[np.searchsorted(commands[0], t_ns, side="right")]
    known = np.where(np.isfinite(wheel[:, 2:]), wheel[:, 2:], commanded)
    tick_rad = 2.0 * math.pi / robot.ticks_per_rev
    spans = (2.0 * math.pi, *(2.0**bits * tick_rad for bits in WIDTHS_BITS))
    begins = np.concatenate([[True], np.diff(t_ns) > LONGEST_SILENCE_NS])
    names = (f"{path}: left wheel", f"{path}: right wheel")
    angles, uncertain = continuous_wheels(
        names, (t_ns - t_ns[0]) * 1e-9, wheel[:, :2], spans, begins, known, notes, "rad"
    )
    return np.column_stack([angles, wheel[:, 2:]]), uncertain
