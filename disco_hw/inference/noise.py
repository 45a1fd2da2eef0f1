"""The log's own noise: of the pose sensor, and of the slip that no parameter explains."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from disco_hw.inference.excitation import Excitation

Array = NDArray[np.float64]

_LAGS_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.0)
_CORRELATIONS_S = (1e-3, 0.1, 0.2, 0.3, 0.5)
_FEWEST_WINDOWS = 12
_LEAST_RATIO = 0.5
# Of a window, the part at either end over which positions are averaged.
_ENDS = 0.25
# Neighbours of a pose; a jump is so many times the median distance from their median (12: about 6 standard deviations).
_NEIGHBOURS = 5
_JUMP = 12.0
_SMALLEST = np.array([2e-4, 2e-4, 2e-4, 2e-4, 5e-4])
_LARGEST = np.array([0.3, 0.5, 0.5, 0.5, 1.0])
# Of a standard normal variable: the median of its square, and the mean of its square held at 9.
_MEDIAN_OF_SQUARE = 0.4549
_MEAN_OF_HELD_SQUARE = 0.995


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations: of a measured position (m, per axis) and yaw (rad), independent from sample to sample; of
    the slip of a moving body forward, left (m per sqrt(s)) and in yaw (rad per sqrt(s)), a random walk.
    """

    position_m: float
    yaw_rad: float
    slip_forward_m_sqrt_s: float
    slip_left_m_sqrt_s: float
    slip_yaw_rad_sqrt_s: float

    def vector(self) -> Array:
        """The five numbers in order, (5,)."""
        return np.array(
            [
                self.position_m,
                self.yaw_rad,
                self.slip_forward_m_sqrt_s,
                self.slip_left_m_sqrt_s,
                self.slip_yaw_rad_sqrt_s,
            ]
        )


USUAL = Noise(0.005, 0.01, 0.005, 0.005, 0.015)


def measured_noise(drive: Excitation, theta: Array) -> Noise:
    """The noise in what a geometry leaves unexplained; `theta` (3,) is x_icr, wheel radius, axial distance (m).

    Errors of predicted displacement over several lags: sensor noise adds the same variance to each, slip one that grows
    with the time in motion (structure function). Errors beyond three standard deviations are held there, so that jumps
    of the sensor do not count.
    """
    error = _errors(drive, theta)
    moved = np.concatenate([np.cumsum(drive.moving_s[lo:hi]) for lo, hi in _bounds(drive)])
    rows: list[tuple[float, float, float, Array]] = []
    period_s = float(np.median(np.diff(drive.t_s)[~drive.starts[1:]]))
    for lag in sorted({max(1, round(lag_s / period_s)) for lag_s in _LAGS_S}):
        ends = max(1, round(_ENDS * lag))
        squares, moving = _windows(drive, error, moved, lag, ends)
        length_s = lag * period_s
        for chosen in (moving < 0.05 * length_s, moving > 0.9 * length_s):
            if np.count_nonzero(chosen) >= _FEWEST_WINDOWS:
                # Windows overlap by half.
                independent = 0.5 * np.count_nonzero(chosen) if lag > 1 else float(np.count_nonzero(chosen))
                # A random walk from the mean of one end to that of the other grows by a third of an end less.
                time_s = float(np.mean(moving[chosen])) * (1.0 - (ends - 1) / (3.0 * lag))
                rows.append((time_s, 2.0 / ends, independent, _variance(squares[chosen])))
    if len(rows) < 3:
        return USUAL
    times_s, sensor, counts = np.array([row[:3] for row in rows]).T
    variances = np.array([row[3] for row in rows])
    forward, left, yaw = (_two_terms(times_s, sensor, counts, variances[:, axis]) for axis in range(3))
    position = 0.5 * (forward[0] + left[0])
    # Short drives say little of the smaller one; wheels that slip one way on a floor slip the other way too.
    least = _LEAST_RATIO**2 * max(forward[1], left[1])
    forward, left = (forward[0], max(forward[1], least)), (left[0], max(left[1], least))
    found = np.sqrt([position, yaw[0], forward[1], left[1], yaw[1]])
    return Noise(*np.clip(found, _SMALLEST, _LARGEST).tolist())


def _variance(squares: Array) -> Array:
    """Variances (axes,) from squared errors (W, axes), those beyond three standard deviations held there."""
    rough = np.median(squares, axis=0) / _MEDIAN_OF_SQUARE
    held: Array = np.minimum(squares, 9.0 * rough).mean(axis=0) / _MEAN_OF_HELD_SQUARE
    return held


def _two_terms(time_s: Array, sensor: Array, counts: Array, variance: Array) -> tuple[float, float]:
    """Sensor variance R and slip variance q per second in `variance = sensor R + q time`, both not negative.

    Slip that keeps its direction for a while grows slower at first, as time - tau (1 - exp(-time / tau)); its rate
    later on is what parameters feel. Errors are relative to the variance and fall with the number of windows.
    """
    precision = np.sqrt(counts)
    scale = precision / np.maximum(variance, 1e-12)
    best, best_cost = (0.0, 0.0), np.inf
    for tau_s, use in product(_CORRELATIONS_S, ((True, True), (True, False), (False, True))):
        grown = time_s + tau_s * np.expm1(-time_s / tau_s)
        columns = np.column_stack([sensor, grown])[:, use]
        solution, *_ = np.linalg.lstsq(columns * scale[:, None], variance * scale, rcond=None)
        cost = float(np.sum((columns @ solution * scale - variance * scale) ** 2))
        if (solution >= 0.0).all() and cost < best_cost:
            full = np.zeros(2)
            full[list(use)] = solution
            best, best_cost = (float(full[0]), float(full[1])), cost
    return best


def _bounds(drive: Excitation) -> list[tuple[int, int]]:
    return list(pairwise(drive.run_pose.tolist()))


def _errors(drive: Excitation, theta: Array) -> Array:
    """Measured minus predicted path, summed up within each run: world x, y (m), and yaw (rad), (P, 3)."""
    x_icr, radius, axial = theta
    parts = []
    for lo, hi in _bounds(drive):
        pose, roll = drive.pose[lo:hi], drive.roll_rad[lo + 1 : hi]
        yaw = pose[:, 2]
        middle = 0.5 * (yaw[1:] + yaw[:-1])
        turn = radius / axial * roll[:, 1]
        forward, left = radius * roll[:, 0], -x_icr * 2.0 * np.sin(0.5 * turn)
        cosine, sine = np.cos(middle), np.sin(middle)
        steps = np.column_stack([forward * cosine - left * sine, forward * sine + left * cosine, turn])
        predicted = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        parts.append(_without_jumps(pose - pose[0] - predicted))
    return np.concatenate(parts)


def _without_jumps(error: Array) -> Array:
    """Errors (P, 3) with single values far from their neighbours' median put back on it."""
    middle = median_filter(error, size=(_NEIGHBOURS, 1), mode="nearest")
    apart = np.abs(error - middle)
    return np.where(apart > _JUMP * np.maximum(np.median(apart, axis=0), 1e-9), middle, error)


def _windows(drive: Excitation, error: Array, moved_s: Array, lag: int, ends: int) -> tuple[Array, Array]:
    """Squared errors over windows of `lag` poses: forward, left, yaw (W, 3); and the time in motion (W,).

    From the mean of `ends` poses to the mean of the `ends` that are `lag` later, which quietens the sensor.
    """
    squares, moving = [], []
    stride = max(1, lag // 2)
    for lo, hi in _bounds(drive):
        if hi - lo < lag + ends:
            continue
        start = np.arange(lo, hi - lag - ends + 1, stride)
        within = np.arange(ends)
        step = (error[start[:, None] + lag + within] - error[start[:, None] + within]).mean(axis=1)
        yaw = drive.pose[start + lag // 2, 2]
        cosine, sine = np.cos(yaw), np.sin(yaw)
        forward, left = step[:, 0] * cosine + step[:, 1] * sine, step[:, 1] * cosine - step[:, 0] * sine
        squares.append(np.column_stack([forward, left, step[:, 2]]) ** 2)
        moving.append(moved_s[start + lag] - moved_s[start])
    if not squares:
        return np.empty((0, 3)), np.empty(0)
    return np.concatenate(squares), np.concatenate(moving)
