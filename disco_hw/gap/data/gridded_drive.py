"""A drive on an even time grid: what the free runs of the channels read, prepared once.

The grid's nodes are `GRID_STEP_S` apart within a run; a run is a stretch of one segment in which the wheels were
measured and, for the command channel, the commands were known. Runs follow each other in the same arrays. Wheel speeds
that a log only holds until the next one comes are taken once, when they were new (sample and hold): robots report them
at 4 to 10 Hz, and laid on the interval that it ends a speed is neither late nor smoother than what was measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from disco_hw.gap.data.command_timing import command_clock
from disco_hw.gap.data.stamp_clock import Aligned, aligned, joined
from disco_hw.gap.data.timing import pose_clock, tick_s
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S, OF_MEDIAN, Folds, GapSettings, GridSettings
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GridSamples:
    """Positions of measurements on the grid, all (S,): node before, fraction of a cell after it, time, time block."""

    node: Index
    fraction: Array
    t_s: Array
    block: Index


@dataclass(frozen=True, slots=True)
class GriddedDrive:
    """A drive on the grid.

    Nodes (M,): `t_s`, `first` (begins a run), `command_rad_s` (M, 2) mean over the cell that starts there, NaN where no
    command is known; `angle_rad`, `speed_rad_s` (M, 2) measured. `encoder`: wheel samples with `encoder_angle_rad`
    (E, 2) laid on even times, its stamps scatter by `stamp_scatter_s`; `pose`: pose samples with `pose` (P, 3) x, y,
    yaw not wrapped within a run. `known_command` (M, 2) rad/s and `known_motion` (M, 3) m/s, m/s, rad/s: what the
    terms without a name that a given model has add; None without. `settings` travel with the drive: what judges it
    reads them there. `pose_delay_s`: how much older than their stamps poses are at first sight, s;
    `pose_clock_even`: whether their clock neither drifts nor jumps. Commands and poses are laid where they belong at
    first sight: `commands_moved_s` later than their stamps, so that they change at the borders of cells, and
    `poses_moved_s` earlier. `commands_timed`: whether it is known where commands belong. `command_stamps_s`,
    `pose_stamps_s`: standard deviation of how much older they may be in another log, where this one stamps them by its
    rows or several are searched together; `log_begins_s`: when each of these begins.
    """

    t_s: Array
    first: Mask
    command_rad_s: Array
    command_change: Array
    angle_rad: Array
    speed_rad_s: Array
    encoder: GridSamples
    encoder_angle_rad: Array
    encoder_period_s: float
    stamp_scatter_s: float
    quantum_rad: float
    pose: GridSamples
    pose_values: Array
    notes: tuple[str, ...] = ()
    known_command: Array | None = None
    known_motion: Array | None = None
    settings: GapSettings = DEFAULT_SETTINGS
    pose_delay_s: float = 0.0
    pose_clock_even: bool = True
    commands_moved_s: float = 0.0
    commands_timed: bool = True
    poses_moved_s: float = 0.0
    command_stamps_s: float = 0.0
    pose_stamps_s: float = 0.0
    log_begins_s: tuple[float, ...] = (0.0,)

    @property
    def has_commands(self) -> bool:
        """Whether enough commands are known to judge the wheels."""
        known = np.count_nonzero(np.isfinite(self.command_rad_s[:, 0]))
        return bool(known > 0.02 * self.t_s.size and self.encoder.t_s.size > self.settings.grid.fewest_samples)

    @property
    def has_poses(self) -> bool:
        """Whether enough poses were measured to judge the body."""
        return self.pose.t_s.size > self.settings.grid.fewest_samples

    @property
    def duration_s(self) -> float:
        """Time covered by the grid."""
        return float(self.t_s.size * GRID_STEP_S)

    @property
    def folds(self) -> Folds:
        """Division of the drive into folds, each of which is predicted from the others."""
        prediction = self.settings.prediction
        is_long = self.duration_s >= 3 * prediction.folds.count * prediction.folds.stretch_s
        return prediction.folds if is_long else prediction.short_folds

    def stretch(self, t_s: Array) -> Index:
        """Return the stretch, left out as a whole, in which each time lies: one log of several, or so many seconds.

        What logs differ by is then part of the errors. Too few logs to judge by are divided as a single one is.
        """
        if len(self.log_begins_s) < self.settings.selection.fewest_blocks:
            return np.floor(t_s / self.folds.stretch_s).astype(np.int64)
        return np.maximum(np.searchsorted(self.log_begins_s, t_s, side="right") - 1, 0).astype(np.int64)

    def delayed_commands(self, delay_s: float) -> Array:
        """Commands at the nodes (M, 2) that are in force after a dead time, negative of commands that are stamped late.

        Zero where none is known, before the first and after the last as these.
        """
        raw = np.nan_to_num(self.command_rad_s)
        cells = round((delay_s - self.commands_moved_s) / GRID_STEP_S)
        return raw[np.clip(np.arange(raw.shape[0]) - cells, 0, raw.shape[0] - 1)]


def grid_drive(log: DriveLog, settings: GapSettings = DEFAULT_SETTINGS) -> GriddedDrive:
    """Lay a drive on the grid; a log without wheel samples has an empty one."""
    grid_settings = settings.grid
    wheels = undo_sample_hold(log.wheels, grid_settings)
    timed_commands, timed_poses, commands_moved_s, timing_notes = _timed(log, wheels, grid_settings)
    ticks_s = {"commands": tick_s(log.commands.t_s, log.wheels.t_s), "poses": tick_s(log.poses.t_s, log.wheels.t_s)}
    scatter_s = {whose: each_s / 12.0**0.5 for whose, each_s in ticks_s.items()}
    command_samples, poses, notes = timed_commands.samples, timed_poses.samples, [*timing_notes]
    notes += [
        f"{whose} are stamped by the rows of the log, {1e3 * ticks_s[whose]:.0f} ms apart: how late they are is known "
        f"to {2e3 * each_s:.0f} ms at best"
        for whose, each_s in scatter_s.items()
        if ticks_s[whose] > grid_settings.least_clock_error_s
    ]
    nodes_t, nodes_first, commands, changes, angles, speeds = [], [], [], [], [], []
    encoder_at, encoder_angle, pose_at, pose_values = [], [], [], []
    offset, foreign_s = 0, 0.0
    runs = _runs(wheels.t_s, wheels.segment, grid_settings)
    driven_s = sum(float(wheels.t_s[hi - 1] - wheels.t_s[lo]) for lo, hi in runs)
    if driven_s > grid_settings.longest_s:
        runs = _spread(wheels.t_s, runs, driven_s, _commanded(command_samples, wheels), grid_settings)
        notes.append(
            f"{driven_s:.0f} s of driving: {grid_settings.longest_s:.0f} s of it, evenly spread and those with "
            "commands first, are judged"
        )
    for lo, hi in runs:
        t = wheels.t_s[lo:hi]
        angle = np.column_stack([wheels.left_angle_rad[lo:hi], wheels.right_angle_rad[lo:hi]])
        angle = angle - angle[0]
        segment = int(wheels.segment[lo])
        grid = t[0] + GRID_STEP_S * np.arange(int((t[-1] - t[0]) / GRID_STEP_S) + 1)
        at = np.column_stack([np.interp(grid, t, angle[:, side]) for side in (0, 1)])
        command, change = _command_cells(command_samples, segment, grid)
        span_s = max(grid_settings.speed_span_s, float(np.median(np.diff(t))))
        speed = _speeds(grid, t, angle, span_s)
        foreign = _foreign(command, speed, span_s, grid_settings)
        command[foreign] = np.nan
        foreign_s += GRID_STEP_S * int(foreign.sum())
        nodes_t.append(grid)
        nodes_first.append(np.arange(grid.size) == 0)
        commands.append(command)
        changes.append(change)
        angles.append(at)
        speeds.append(speed)
        even = np.clip(even_times(t, grid_settings.even_samples), grid[0], grid[-1])
        moved = np.column_stack([np.interp(t, grid, speed[:, side]) for side in (0, 1)]) * (even - t)[:, None]
        encoder_at.append(_locate(even, grid, offset, grid_settings.block_s))
        encoder_angle.append(angle + moved)
        here = (poses.segment == segment) & (poses.t_s >= grid[0] + 0.02) & (poses.t_s <= grid[-1] - GRID_STEP_S)
        pose_at.append(_locate(poses.t_s[here], grid, offset, grid_settings.block_s))
        yaw = np.unwrap(poses.yaw_rad[here]) if here.any() else np.empty(0)
        pose_values.append(np.column_stack([poses.x_m[here], poses.y_m[here], yaw]))
        offset += grid.size
    if not nodes_t:
        return _empty(settings)
    if foreign_s > 0.0:
        notes.append(f"{foreign_s:.0f} s in which wheels and commands have nothing to do with each other are left out")
    encoder = joined(encoder_at)
    measured = np.concatenate(encoder_angle)
    return GriddedDrive(
        t_s=np.concatenate(nodes_t),
        first=np.concatenate(nodes_first),
        command_rad_s=np.concatenate(commands),
        command_change=np.concatenate(changes),
        angle_rad=np.concatenate(angles),
        speed_rad_s=np.concatenate(speeds),
        encoder=encoder,
        encoder_angle_rad=measured,
        encoder_period_s=float(np.median(np.diff(wheels.t_s))),
        stamp_scatter_s=_scatter(wheels.t_s),
        quantum_rad=_quantum(np.column_stack([wheels.left_angle_rad, wheels.right_angle_rad]))
        if wheels.angle_measured
        else 0.0,
        pose=joined(pose_at),
        pose_values=np.concatenate(pose_values),
        notes=tuple(notes),
        settings=settings,
        pose_delay_s=timed_poses.delay_s,
        pose_clock_even=timed_poses.even,
        commands_moved_s=commands_moved_s,
        commands_timed=timed_commands.known,
        poses_moved_s=timed_poses.delay_s,
        command_stamps_s=math.hypot(scatter_s["commands"], timed_commands.apart_s),
        pose_stamps_s=math.hypot(scatter_s["poses"], timed_poses.apart_s),
        log_begins_s=log.begins_s,
    )


def _timed(
    log: DriveLog, wheels: Wheels, settings: GridSettings
) -> tuple[Aligned[Commands], Aligned[Poses], float, tuple[str, ...]]:
    """Commands and poses where they belong beside the wheels at first sight, by how much (s) commands moved; notes."""
    poses = aligned(
        wheels, log.poses, log.begins_s, lambda wheels, some: (pose_clock(wheels, some, settings), True),
        settings.least_clock_error_s, "poses'",
    )  # fmt: skip
    commands = aligned(
        wheels, log.commands, log.begins_s, lambda wheels, some: command_clock(wheels, some, settings),
        settings.least_link_error_s, "commands'",
    )  # fmt: skip
    notes = (*poses.notes, *commands.notes)
    if not commands.known:
        text = (
            f"wheels answer commands more slowly than behind a lag of {max(settings.lags_s):g} s, or more than "
            f"{settings.most_pose_delay_s:g} s late or early, or commands hardly change: how late commands are stamped "
            "is not known from this log"
        )
        notes = (*notes, text)
    later_s = _to_borders(commands.samples, float(wheels.t_s[0]), -commands.delay_s) if wheels.t_s.size else 0.0
    asked = replace(commands.samples, t_s=_moved(commands.samples.t_s, later_s))
    seen = replace(poses.samples, t_s=_moved(poses.samples.t_s, -poses.delay_s))
    return replace(commands, samples=asked), replace(poses, samples=seen), later_s, notes


def _to_borders(commands: Commands, begin_s: float, later_s: float) -> float:
    """Return the shift (s) nearest to `later_s` that puts changes of commands on cell borders, on average.

    A delay of a part of a cell is made by a mean of neighbouring cells: a change within a cell would be smeared twice.
    """
    speeds = np.nan_to_num(np.column_stack([commands.left_rad_s, commands.right_rad_s]))
    changes = (np.diff(speeds, axis=0) ** 2).sum(axis=1)
    turn = 2.0j * np.pi / GRID_STEP_S
    mean = complex(np.sum(changes * np.exp(turn * (commands.t_s[1:] - begin_s))))
    within_s = float(np.angle(mean)) / abs(turn)
    return round((later_s + within_s) / GRID_STEP_S) * GRID_STEP_S - within_s


def _moved(t_s: Array, by_s: float) -> Array:
    """Return times shifted by `by_s`, to the nanosecond: the last digits would decide the cell of a sample."""
    return np.asarray(np.round(t_s + by_s, 9))


def even_times(t_s: Array, neighbours: int) -> Array:
    """Return times (N,) without the jitter of their stamps: means over up to `neighbours` samples on either side.

    Where samples are lost the stamp itself stays. Angles read by jittering stamps would make every response look
    weaker than it is; moved to even times by the measured speed they do not.
    """
    if t_s.size < 3:
        return t_s
    half = np.minimum(np.minimum(np.arange(t_s.size), np.arange(t_s.size)[::-1]), neighbours)
    total = np.concatenate([[0.0], np.cumsum(t_s)])
    index = np.arange(t_s.size)
    even = (total[index + half + 1] - total[index - half]) / (2 * half + 1)
    return np.where(np.abs(even - t_s) < 0.5 * float(np.median(np.diff(t_s))), even, t_s)


def _scatter(t_s: Array) -> float:
    """Scatter of time stamps, s: robust standard deviation of their differences over the root of two."""
    steps = np.diff(t_s)
    return float(OF_MEDIAN * np.median(np.abs(steps - np.median(steps))) / 2.0**0.5)


def _runs(t_s: Array, segment: Index, settings: GridSettings) -> list[tuple[int, int]]:
    """Stretches of one segment without silence, as half-open index ranges."""
    if t_s.size < 2:
        return []
    breaks = np.flatnonzero((np.diff(segment) != 0) | (np.diff(t_s) > settings.longest_silence_s)) + 1
    edges = [0, *breaks.tolist(), t_s.size]
    pairs = pairwise(edges)
    return [(lo, hi) for lo, hi in pairs if hi - lo > 2 and t_s[hi - 1] - t_s[lo] >= settings.lead_s]


def _commanded(commands: Commands, wheels: Wheels) -> Mask:
    """Whether the command is known at the wheels' samples, (N,)."""
    last = np.searchsorted(commands.t_s, wheels.t_s, side="right") - 1
    if not commands.t_s.size:
        return np.zeros(wheels.t_s.size, dtype=bool)
    known = np.isfinite(commands.left_rad_s[last]) & (commands.segment[last] == wheels.segment)
    return np.asarray(known & (last >= 0))


def _spread(
    t_s: Array, runs: list[tuple[int, int]], driven_s: float, commanded: Mask, settings: GridSettings
) -> list[tuple[int, int]]:
    """Stretches of `stretch_s` of the runs that add up to about `longest_s`, neighbours joined.

    Evenly spread over those in which commands are known; the others, which show nothing of the way from command to
    wheel, only as far as these do not suffice.
    """
    stretches = []
    for lo, hi in runs:
        edges = np.arange(t_s[lo], t_s[hi - 1], settings.stretch_s)
        cuts = [*np.searchsorted(t_s[lo:hi], edges).tolist(), hi - lo]
        stretches += [(lo + a, lo + b) for a, b in pairwise(cuts) if b - a > 2]
    most = max(int(len(stretches) * settings.longest_s / driven_s), 1)
    known = np.array([bool(commanded[lo:hi].any()) for lo, hi in stretches])
    kept: list[int] = []
    for group in (np.flatnonzero(known), np.flatnonzero(~known)):
        count = min(most - len(kept), group.size)
        if count:
            kept += group[np.unique(np.linspace(0, group.size - 1, count).astype(int))].tolist()
    begins = {lo for lo, _ in runs}
    pieces: list[tuple[int, int]] = []
    for lo, hi in (stretches[k] for k in sorted(kept)):
        if pieces and pieces[-1][1] == lo and lo not in begins:
            pieces[-1] = (pieces[-1][0], hi)
        else:
            pieces.append((lo, hi))
    return [(lo, hi) for lo, hi in pieces if t_s[hi - 1] - t_s[lo] >= settings.lead_s]


def _locate(t_s: Array, grid: Array, offset: int, block_s: float) -> GridSamples:
    """Positions of times on a run's grid whose first node has index `offset`."""
    place = (t_s - grid[0]) / GRID_STEP_S
    node = np.clip(np.floor(place).astype(np.int64), 0, grid.size - 2)
    return GridSamples(node + offset, place - node, t_s, np.floor(t_s / block_s).astype(np.int64))


def _command_cells(commands: Commands, segment: int, grid: Array) -> tuple[Array, Array]:
    """Mean command over each cell (M, 2), exact for commands held until the next, and the squared jumps in it (M,)."""
    inside = commands.segment == segment
    t, values = commands.t_s[inside], np.column_stack([commands.left_rad_s[inside], commands.right_rad_s[inside]])
    if not t.size:
        return np.full((grid.size, 2), np.nan), np.zeros(grid.size)
    known = np.isfinite(values[:, 0])
    filled = np.nan_to_num(values)
    edges = np.append(grid, grid[-1] + GRID_STEP_S)
    ends = np.append(t[1:], max(edges[-1], t[-1]) + 1.0)
    integral = np.concatenate([np.zeros((1, 2)), np.cumsum(filled * (ends - t)[:, None], axis=0)])
    knots = np.append(t, ends[-1])
    means = np.column_stack([np.diff(np.interp(edges, knots, integral[:, side])) for side in (0, 1)]) / GRID_STEP_S
    unknown = np.concatenate([[0.0], np.cumsum((~known) * (ends - t))])
    is_unknown = np.diff(np.interp(edges, knots, unknown)) > 1e-9
    means[is_unknown | (grid < t[0] - 1e-9)] = np.nan
    jumps = np.zeros(grid.size)
    steps = (np.diff(filled, axis=0) ** 2).mean(axis=1)
    where = np.clip(((t[1:] - grid[0]) / GRID_STEP_S).astype(np.int64), 0, grid.size - 1)
    np.add.at(jumps, where, steps)
    return means, jumps


def _foreign(command: Array, speed: Array, span_s: float, settings: GridSettings) -> Mask:
    """Cells (M,) in which wheels turn long after the last command or rest under a large one: another master drives.

    A speed taken over `span_s` either side rises that much before the command that it follows.
    """
    largest = np.nan_to_num(np.abs(command).max(axis=1), nan=np.inf)
    turning = np.abs(speed).max(axis=1)
    span = round(settings.longest_response_s / GRID_STEP_S)
    before = maximum_filter1d(largest, span, origin=(span - 1) // 2)
    most = np.maximum(before, maximum_filter1d(largest, 2 * math.ceil(span_s / GRID_STEP_S) + 3))
    least = minimum_filter1d(largest, span, origin=(span - 1) // 2)
    unasked = (most < settings.rest_rad_s) & (turning > settings.turning_rad_s)
    unheard = (least > settings.loud_rad_s) & np.isfinite(largest) & (turning < settings.rest_rad_s)
    return np.asarray(maximum_filter1d((unasked | unheard).astype(np.uint8), 2 * span) > 0)


def _speeds(grid: Array, t: Array, angle: Array, span_s: float) -> Array:
    """Speeds at the nodes from differences of the angle over `span_s` either side, (M, 2)."""
    low, high = np.maximum(grid - span_s, t[0]), np.minimum(grid + span_s, t[-1])
    columns = [np.interp(high, t, angle[:, side]) - np.interp(low, t, angle[:, side]) for side in (0, 1)]
    return np.asarray(np.column_stack(columns) / (high - low)[:, None])


def _quantum(angle: Array) -> float:
    """Estimate the smallest step of the wheel angles, rad; 0 if they change 100 times or less."""
    steps = np.abs(np.diff(angle, axis=0)).ravel()
    steps = steps[steps > 1e-9]
    return float(np.quantile(steps, 0.001)) if steps.size > 100 else 0.0


def _empty(settings: GapSettings) -> GriddedDrive:
    nothing, pairs = np.empty(0), np.empty((0, 2))
    samples = GridSamples(np.empty(0, np.int64), nothing, nothing, np.empty(0, np.int64))
    return GriddedDrive(
        nothing, np.empty(0, bool), pairs, nothing, pairs, pairs, samples, pairs, 0.0, 0.0, 0.0, samples,
        np.empty((0, 3)), settings=settings,
    )  # fmt: skip


def undo_sample_hold(wheels: Wheels, settings: GridSettings) -> Wheels:
    """Remove repeated samples of held wheel speeds, and integrate the angles again by the backward rectangle rule.

    Speeds from which the angles were derived are held if the log repeats more than `repeated_share` of those of turning
    wheels. Other wheels stay unchanged.
    """
    if wheels.angle_measured or wheels.t_s.size < 3:
        return wheels
    speed = np.column_stack([wheels.left_speed_rad_s, wheels.right_speed_rad_s])
    same_run = np.diff(wheels.segment) == 0
    repeated = (np.diff(speed, axis=0) == 0.0).all(axis=1) & same_run
    turning = (np.abs(speed[1:]) > settings.rest_rad_s).any(axis=1)
    if turning.sum() < 20 or float(repeated[turning].mean()) < settings.repeated_share:
        return wheels
    new = np.concatenate([[True], ~repeated])
    period_s = float(np.median(np.diff(wheels.t_s[new])))
    keep, last_s = new.copy(), wheels.t_s[0]
    # Wheels that rest repeat their zeros: those are measured too, as often as the robot measures.
    for k in range(1, wheels.t_s.size):
        if not keep[k] and wheels.t_s[k] - last_s > settings.repeated_periods * period_s:
            keep[k] = True
        if keep[k]:
            last_s = wheels.t_s[k]
    t_s, speed, segment = wheels.t_s[keep], speed[keep], wheels.segment[keep]
    step_s = np.where(np.diff(segment, prepend=segment[0]) == 0, np.diff(t_s, prepend=t_s[0]), 0.0)
    angle = np.cumsum(speed * step_s[:, None], axis=0)
    return replace(
        wheels,
        t_s=t_s,
        left_angle_rad=angle[:, 0],
        right_angle_rad=angle[:, 1],
        left_speed_rad_s=speed[:, 0],
        right_speed_rad_s=speed[:, 1],
        segment=segment,
    )
