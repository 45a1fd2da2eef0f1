"""Increments of commands, wheels and poses over windows of one second, and robust fits between them.

A contradiction between the three shows in the increments before any model is fitted. Windows lie where wheels were
measured and overlap by three quarters. The fits go from wheels to poses and from commands to wheels; each says how well
it explains the data.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import Array, Commands, DriveLog

# Chosen: longer than delays of wheels and poses, so that they hardly show, and short beside the manoeuvres.
WINDOW_S = 1.0
# A quarter of the window: more windows, which overlap, add little.
STEP_S = 0.25
# Chosen: a shorter gap is bridged by a straight line, of a window with a longer one nothing is known.
_LONGEST_GAP_S = 0.6
# Rounding of sums of times.
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
    in_segment: Mask = np.asarray(commands.segment == segment)
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
        _increments(*_integrated(commands, in_segment), begin),
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


# Chosen: in a window, above the noise of counts and poses.
MOVING_RAD = 0.3
# Chosen: in a window, above the noise of a heading.
TURNING_RAD = 0.05
STRAIGHT_ON_RAD = math.radians(30.0)
# Chosen: of the nominal one, what a pneumatic tyre, wear or a guess leave it at; beyond is another fault.
USUAL_RADIUS = (0.7, 1.4)
# Chosen: skid-steering may turn by a third of the nominal, and by no more than the radius explains.
USUAL_TURN = (0.3, 1.4)
# Chosen: two seconds of overlapping windows; fewer decide nothing.
FEWEST_WINDOWS = 8
# Chosen: passes of iteratively reweighted least squares; more take longer.
_PASSES = 4
# Chosen: shares of the residuals that count in full, and that count at all: outliers are at most a tenth.
_TRUSTED = 0.8
_KEPT = 0.9
# Chosen: with less turning, noise decides on the ratio of the turns.
_LEAST_TURNED_RAD = 1.0
# Chosen: small beside real turning, enough to decide where the lever cannot be told.
_LEVER_PRIOR = 0.1
# Chosen: with less rolling, noise decides on the ratio of the ways.
_LEAST_ROLLED_RAD = 3.0
# What counts as not moved at all, so that a fit to nothing explains nothing.
_NOTHING = 1e-9

Columns = NDArray[Any]


def fit_robustly(columns: Columns, values: Columns) -> tuple[Columns, float]:
    """Coefficients (k,) of `columns` (N, k) for `values` (N,), and the share of the values that is left unexplained.

    Iteratively reweighted least squares (Huber): jumps count little. The share is a ratio of root mean squares without
    the worst tenth of the residuals: 0 for a perfect fit, about 1 where columns and values are unrelated.
    """
    weight = np.ones(values.size)
    for _ in range(_PASSES):
        solution = np.linalg.lstsq(columns * weight[:, None], values * weight, rcond=None)[0]
        residual = np.abs(values - columns @ solution)
        limit = max(float(np.quantile(residual, _TRUSTED)), _NOTHING)
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(residual, _NOTHING)))
    kept = residual <= np.quantile(residual, _KEPT)
    size = float(np.sum(np.abs(values[kept]) ** 2))
    return np.asarray(solution), math.sqrt(float(np.sum(residual[kept] ** 2)) / size) if size > _NOTHING**2 else 1.0


@dataclass(frozen=True, slots=True)
class BodyFit:
    """Geometry that explains poses by wheels, and the shares of turning and of displacement that it leaves unexplained.

    `turn_ratio`, `radius_ratio`: over the nominal ones; the first is negative where the heading turns against the
    wheels. `turn_size`: how much the heading turns beside what the nominal geometry makes of the wheels, related or
    not. `course_rad`: direction of travel relative to the heading. A share is None where too little of it moved.
    """

    turn_ratio: float
    turn_size: float
    radius_ratio: float
    course_rad: float
    turn_unexplained: float | None
    way_unexplained: float | None

    @property
    def worst(self) -> float:
        """The larger share that is left unexplained; 0 where nothing can be said."""
        return max(self.turn_unexplained or 0.0, self.way_unexplained or 0.0)

    @property
    def has_clear_axes(self) -> bool:
        """Whether the robot moves along its heading, ahead or backwards, as far as its wheels roll."""
        low, high = USUAL_RADIUS
        along = min(abs(self.course_rad), math.pi - abs(self.course_rad)) < STRAIGHT_ON_RAD
        return self.way_unexplained is None or (along and low < self.radius_ratio < high)

    @property
    def is_usual(self) -> bool:
        """Whether the geometry can be the robot's: skid-steers turn by 0.3 to 1 of what their track makes of it."""
        low, high = USUAL_TURN
        turns = self.turn_unexplained is None or low < self.turn_ratio < high
        return turns and self.has_clear_axes and (self.way_unexplained is None or abs(self.course_rad) < 1.0)


def fit_body(
    windows: MotionWindows,
    radius_m: float,
    axial_m: float,
    factors: tuple[float, float] = (1.0, 1.0),
    mirrored: bool = False,
    below: float = math.inf,
) -> BodyFit | None:
    """Fit poses to the wheels' roll times `factors`, positions `mirrored` if told; None if too little is known.

    None as well where the turning alone shows that `worst` would not be `below`.
    """
    known = np.isfinite(windows.rolled_rad).all(axis=1) & np.isfinite(windows.turned_rad)
    known &= np.abs(np.nan_to_num(windows.rolled_rad)).max(axis=1) > MOVING_RAD
    if np.count_nonzero(known) < FEWEST_WINDOWS:
        return None
    left, right = (windows.rolled_rad[known] * np.array(factors)).T
    nominal_turn = radius_m / axial_m * (right - left)
    rolled = 0.5 * (left + right)
    turned, heading, way = windows.turned_rad[known], windows.heading_rad[known], windows.moved_m[known]
    turning = np.abs(nominal_turn) > TURNING_RAD
    # Windows overlap by three quarters.
    enough_turn = 0.25 * float(np.abs(nominal_turn).sum()) > _LEAST_TURNED_RAD
    enough_way = 0.25 * float(np.abs(rolled).sum()) > _LEAST_ROLLED_RAD
    kappa, turn_unexplained = fit_robustly(nominal_turn[:, None], turned)
    if enough_turn and turn_unexplained >= below:
        return None
    # What the robot's centre of rotation, or the sensor's place on it, adds where it turns is fitted beside; on a
    # steady circle it cannot be told from the rest, and the added row decides for none.
    ahead, lever = radius_m * rolled, 1j * nominal_turn
    row = np.array([[0.0, _LEVER_PRIOR * np.linalg.norm(lever)]])
    columns = np.vstack([np.column_stack([ahead, lever]), row]).astype(np.complex128)
    body_way = (np.conj(way) if mirrored else way) * np.exp(-1j * heading)
    gain, way_unexplained = fit_robustly(columns, np.append(body_way, 0.0))
    return BodyFit(
        float(kappa[0].real),
        float(np.median(np.abs(turned[turning])) / np.median(np.abs(nominal_turn[turning]))) if turning.any() else 0.0,
        float(abs(gain[0])),
        cmath.phase(complex(gain[0])),
        turn_unexplained if enough_turn else None,
        way_unexplained if enough_way else None,
    )


@dataclass(frozen=True, slots=True)
class CommandFit:
    """Gains from commands to the left and right wheel, and the share of each wheel's roll that is left unexplained.

    `commanded_rad`: the usual roll that is commanded in a window.
    """

    gains: tuple[float, float]
    unexplained: tuple[float, float]
    commanded_rad: float

    @property
    def worst(self) -> float:
        """The larger share that is left unexplained."""
        return max(self.unexplained)


def fit_commands(windows: MotionWindows, swapped: bool = False) -> CommandFit | None:
    """Fit the roll of each wheel to its command, or to that of the other one; None if too little is known."""
    known = np.isfinite(windows.rolled_rad).all(axis=1) & np.isfinite(windows.commanded_rad).all(axis=1)
    both = np.maximum(np.abs(windows.rolled_rad), np.abs(windows.commanded_rad)).max(axis=1)
    known &= np.nan_to_num(both) > MOVING_RAD
    if np.count_nonzero(known) < FEWEST_WINDOWS:
        return None
    commanded, rolled = windows.commanded_rad[known], windows.rolled_rad[known]
    fits = [fit_robustly(commanded[:, [1 - side if swapped else side]], rolled[:, side]) for side in (0, 1)]
    gains, unexplained = (float(fits[0][0][0]), float(fits[1][0][0])), (fits[0][1], fits[1][1])
    return CommandFit(gains, unexplained, float(np.median(np.abs(commanded).max(axis=1))))


# Rates of the poses' clock that are tried, and how far it is moved with each, in windows' steps.
_LONGEST_SHIFT_S = 30.0
_LONGEST_SHIFT_OF_RATES_S = 3.0
_RATES = (1.0, 0.5, 2.0, 0.8, 1.25, 0.9, 1.1, 0.95, 1.05, 0.98, 1.02)
# So many windows of the log's begin tell a clock: later on, one that is too fast would be off by more than is tried.
_CLOCK_WINDOWS = 480
_SAME_TIME_S = 1e-6


@dataclass(frozen=True, slots=True)
class ClockFit:
    """Offset (`later_s`, at the log's start) and `rate` of the poses' clock against the wheels' clock."""

    later_s: float
    rate: float
    fit: BodyFit


def fit_pose_clock(log: DriveLog, radius_m: float, axial_m: float, only_offset: bool = False) -> ClockFit | None:
    """Search the offset, up to 30 s, and the rate of the poses' clock with which wheels explain poses best."""
    best: ClockFit | None = None
    for rate in _RATES[:1] if only_offset else _RATES:
        windows = _of_begin(motion_windows(log, rate))
        most = round((_LONGEST_SHIFT_S if rate == 1.0 else _LONGEST_SHIFT_OF_RATES_S) / STEP_S)
        for steps in range(-most, most + 1):
            moved = _shifted(windows, steps)
            # Of hundreds of fits few are better than all before: that turning shows spares most of the costlier rest.
            below = math.inf if best is None else best.fit.worst
            fit = None if moved is None else fit_body(moved, radius_m, axial_m, below=below)
            if fit is not None and fit.turn_unexplained is not None and (best is None or fit.worst < best.fit.worst):
                best = ClockFit(steps * STEP_S, 1.0 / rate, fit)
    return best


def _of_begin(windows: MotionWindows) -> MotionWindows:
    """Return the first windows from where the wheels begin to move."""
    moving = np.flatnonzero(np.nan_to_num(np.abs(windows.rolled_rad)).max(axis=1, initial=0.0) > MOVING_RAD)
    first = int(moving[0]) if moving.size else 0
    part = slice(max(first - 40, 0), first + _CLOCK_WINDOWS)
    return _beside(windows, part, part)


def _beside(windows: MotionWindows, wheels: slice | Mask, poses: slice | Mask) -> MotionWindows:
    """Return the wheels of some windows beside the poses of as many others."""
    rolling = (windows.t_s[wheels], windows.commanded_rad[wheels], windows.rolled_rad[wheels])
    return MotionWindows(*rolling, windows.moved_m[poses], windows.heading_rad[poses], windows.turned_rad[poses])


def _shifted(windows: MotionWindows, steps: int) -> MotionWindows | None:
    """Return the wheels of each window beside the poses of the one `steps` later; None if the log is too short."""
    count = windows.t_s.size - abs(steps)
    if count < FEWEST_WINDOWS:
        return None
    wheels, poses = (slice(0, count), slice(steps, None)) if steps >= 0 else (slice(-steps, None), slice(0, count))
    together = np.abs(windows.t_s[poses] - windows.t_s[wheels] - steps * STEP_S) < _SAME_TIME_S
    return _beside(_beside(windows, wheels, poses), together, together)
