"""Noise of a logged drive: of its measured poses, and of the slip of its moving body.

Both are found from what a geometry leaves unexplained of the path, over windows of several lengths.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from disco_hw.inference.excitation import MOVING_SPREAD_STEPS, Excitation

Array = NDArray[np.float64]

# Chosen: grids that are searched; finer ones take longer.
_LAGS_S = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.0)
_CORRELATIONS_S = (1e-3, 0.03, 0.06, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.75)
_SPEED_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
# Lags short enough for a body that turns to keep its direction, long enough for slip to show beside the sensor.
_SHAPE_LAGS_S = (0.15, 1.0)
# A squared error counts up to so many variances in what tells the shape of the noise.
_LARGEST_SQUARE = 9.0
_FEWEST_WINDOWS = 12
_LEAST_RATIO = 0.25
# Of a window, the part at either end over which positions are averaged.
_ENDS = 0.25
# Neighbours of a pose; a jump is so many times the median distance from their median (12: about 6 standard deviations).
_NEIGHBOURS = 5
_JUMP = 12.0
_SMALLEST = np.array([2e-4, 2e-4, 2e-4, 2e-4, 5e-4])
_LARGEST = np.array([0.3, 0.5, 0.5, 0.5, 1.0])
# Of a standard normal variable: the median of its square, and the mean of its square clipped at 9.
_MEDIAN_OF_SQUARE = 0.4549
_MEAN_OF_CLIPPED_SQUARE = 0.995


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of the measured pose and of slip.

    Of a measured position (m, per axis) and yaw (rad), independent from sample to sample; of the slip of a moving body
    forward, left (m per sqrt(s)) and in yaw (rad per sqrt(s)).

    Slip is a random speed that keeps its direction for `correlation_s` (an Ornstein-Uhlenbeck process; 0: a random
    walk); the standard deviations are of what it adds up to over longer times. Of its variance the part `speed_share`
    grows with the square of the wheels' speed. Slip in yaw turns the body about a point `lever_m` before the tracked
    one, as unequal grip of the wheels does about the centre of rotation.
    """

    position_m: float
    yaw_rad: float
    slip_forward_m_sqrt_s: float
    slip_left_m_sqrt_s: float
    slip_yaw_rad_sqrt_s: float
    correlation_s: float = 0.0
    lever_m: float = 0.0
    speed_share: float = 0.0

    def scales(self) -> Array:
        """Return the five standard deviations, the correlation time and the lever, (7,)."""
        return np.array(astuple(self)[:-1])

    def about_the_point(self) -> Noise:
        """Return noise of the same variances without a lever."""
        left = np.hypot(self.slip_left_m_sqrt_s, self.lever_m * self.slip_yaw_rad_sqrt_s)
        return replace(self, slip_left_m_sqrt_s=float(left), lever_m=0.0)


USUAL = Noise(0.005, 0.01, 0.005, 0.005, 0.015)


def slip_intensity(drive: Excitation, speed_share: float) -> tuple[Array, Array]:
    """Growth (s) of slip's variance over its mean in motion: at nodes (M,), and up to each pose from the last (P,)."""
    window = np.ones(2 * MOVING_SPREAD_STEPS + 1) / (2 * MOVING_SPREAD_STEPS + 1)
    square = np.convolve((drive.wheel_rad_s**2).mean(axis=1), window, mode="same")
    usual = float(square @ drive.moving) / max(float(drive.moving.sum()), 1.0)
    intensity = drive.moving * (1.0 - speed_share + speed_share * square / max(usual, 1e-12))
    grown_s = np.concatenate([[0.0], np.cumsum(intensity) * drive.step_s])
    at_pose = grown_s[drive.node] + drive.fraction * np.diff(grown_s)[drive.node]
    return intensity, np.where(drive.starts, 0.0, np.diff(at_pose, prepend=0.0))


@dataclass(frozen=True, slots=True)
class _Windows:
    """Errors over windows of one lag (W, 3): forward, left, yaw.

    Time in motion and on the slip's clock (W,), s; `growth` of a random walk from the mean of one end to that of the
    other, beside that from end to end; `sensor` (W, 3): how often the sensor's variance is in the error's;
    `independent`: how many windows count, as they overlap by half.
    """

    error: Array
    moving_s: Array
    intensity: Array
    growth: float
    sensor: Array
    independent: float


def measured_noise(drive: Excitation, theta: Array) -> Noise:
    """Return the noise in what a geometry leaves unexplained; `theta` (3,) is x_icr, wheel radius, axial distance (m).

    Errors of predicted displacement over several lags: sensor noise adds the same variance to each, slip one that grows
    with the time in motion (structure function), slower at first the longer it keeps its direction. Errors beyond three
    standard deviations are held there, so that jumps of the sensor do not count.
    """
    error, turned = _in_body(drive, _errors(drive, theta))
    by_speed_s = slip_intensity(drive, 1.0)[1]
    rows: list[_Windows] = []
    shape: list[_Windows] = []
    period_s = float(np.median(np.diff(drive.t_s)[~drive.starts[1:]]))
    for lag in sorted({max(1, round(lag_s / period_s)) for lag_s in _LAGS_S}):
        windows = _windows(drive, error, turned, by_speed_s, lag)
        length_s = lag * period_s
        for moves, chosen in ((False, windows.moving_s < 0.05 * length_s), (True, windows.moving_s > 0.9 * length_s)):
            if np.count_nonzero(chosen) >= _FEWEST_WINDOWS:
                part = _chosen(windows, chosen, 0.5 if lag > 1 else 1.0)
                rows.append(part)
                if moves and _SHAPE_LAGS_S[0] < length_s < _SHAPE_LAGS_S[1]:
                    shape.append(part)
    if len(rows) < 3:
        return USUAL
    times_s = np.array([float(np.mean(row.moving_s)) * row.growth for row in rows])
    sensor, counts = np.array([row.sensor.mean(axis=0) for row in rows]), np.array([row.independent for row in rows])
    variances = np.array([_variance(row.error**2) for row in rows])
    sensors, slips, correlation_s = _two_terms(times_s, sensor, counts, variances)
    lever_m = _lever(shape, sensors[2])
    # Short drives say little of the smaller one; wheels that slip one way on a floor slip the other way too.
    forward, left = slips[0], _left(rows, _grown(times_s, correlation_s), sensors, lever_m)
    least = _LEAST_RATIO**2 * max(forward, left)
    found = np.sqrt([0.5 * (sensors[0] + sensors[1]), sensors[2], max(forward, least), max(left, least), slips[2]])
    share = _speed_share(shape, sensors, slips, correlation_s)
    white = Noise(*np.clip(found, _SMALLEST, _LARGEST).tolist())
    return replace(white, correlation_s=correlation_s, lever_m=lever_m, speed_share=share)


def _chosen(windows: _Windows, chosen: NDArray[np.bool_], independent: float) -> _Windows:
    count = independent * np.count_nonzero(chosen)
    error, moving_s, intensity = windows.error[chosen], windows.moving_s[chosen], windows.intensity[chosen]
    return _Windows(error, moving_s, intensity, windows.growth, windows.sensor[chosen], count)


def _variance(squares: Array) -> Array:
    """Variances (axes,) from squared errors (W, axes), clipped at three standard deviations."""
    rough = np.median(squares, axis=0) / _MEDIAN_OF_SQUARE
    variance: Array = np.minimum(squares, 9.0 * rough).mean(axis=0) / _MEAN_OF_CLIPPED_SQUARE
    return variance


def _grown(time_s: Array, correlation_s: float) -> Array:
    """Time after which a random walk has grown as far as slip that keeps its direction for a while."""
    return np.asarray(time_s + correlation_s * np.expm1(-time_s / correlation_s))


def _two_terms(time_s: Array, sensor: Array, counts: Array, variances: Array) -> tuple[Array, Array, float]:
    """Fit sensor and slip variances, and the correlation time of slip.

    Sensor variances R (axes,), slip variances q (axes,) per second, and the correlation time in `variance = sensor R +
    q grown(time)`; `sensor`, `variances` (rows, axes). R and q are not negative.
    """
    scales = np.sqrt(counts)[:, None] / np.maximum(variances, 1e-12)
    axes = range(variances.shape[1])
    best_cost = np.inf
    for tau_s in _CORRELATIONS_S:
        grown = _grown(time_s, tau_s)
        fits = [
            _not_negative(
                np.column_stack([sensor[:, axis], grown]) * scales[:, [axis]], variances[:, axis] * scales[:, axis]
            )
            for axis in axes
        ]
        cost = sum(fit[1] for fit in fits)
        if cost < best_cost:
            best_cost, best_tau_s, best = cost, tau_s, np.array([fit[0] for fit in fits])
    return best[:, 0], best[:, 1], best_tau_s


def _not_negative(columns: Array, values: Array) -> tuple[Array, float]:
    """Coefficients (2,) of least squares that are not negative, and the sum of squares that is left."""
    best, best_cost = np.zeros(2), np.inf
    for use in ([True, True], [True, False], [False, True]):
        solution, *_ = np.linalg.lstsq(columns[:, use], values, rcond=None)
        cost = float(np.sum((columns[:, use] @ solution - values) ** 2))
        if (solution >= 0.0).all() and cost < best_cost:
            best, best_cost = np.zeros(2), cost
            best[use] = solution
    return best, best_cost


def _lever(windows: list[_Windows], sensor_yaw: float) -> float:
    """Return how far (m) before the tracked point slip turns the body: the slope of errors to the left over yaw's.

    Of both in the same windows, without what the sensor adds to those in yaw.
    """
    together = square = 0.0
    for one in windows:
        left, yaw = one.error[:, 1], one.error[:, 2]
        spread = _variance(one.error[:, 1:] ** 2)
        usual = (left**2 < _LARGEST_SQUARE * spread[0]) & (yaw**2 < _LARGEST_SQUARE * spread[1])
        weight = 1.0 / (one.independent * max(spread[0] * spread[1], 1e-24))
        together -= weight * float((left * yaw)[usual].sum())
        square += weight * float((yaw**2 - one.sensor[:, 2] * sensor_yaw)[usual].sum())
    return together / square if square > 0.0 else 0.0


def _left(rows: list[_Windows], grown_s: Array, sensors: Array, lever_m: float) -> float:
    """Variance per second of the slip to the left at the end of the lever; `grown_s` (rows,) as `_grown` gives it.

    The errors there themselves are taken: of two variances that are nearly the same a difference tells little.
    """
    part = total = 0.0
    for one, grown in zip(rows, grown_s.tolist(), strict=True):
        variance = float(_variance((one.error[:, [1]] + lever_m * one.error[:, [2]]) ** 2)[0])
        sensor, sensor_yaw = one.sensor[:, 1:].mean(axis=0) * sensors[1:]
        weight = one.independent / max(variance, 1e-12) ** 2
        part += weight * grown * (variance - float(sensor + lever_m**2 * sensor_yaw))
        total += weight * grown**2
    return max(part / total, 0.0) if total > 0.0 else 0.0


def _speed_share(windows: list[_Windows], sensors: Array, slips: Array, correlation_s: float) -> float:
    """Return the part of the slip's variance that grows with the square of speed, by likelihood."""
    costs = []
    for share in _SPEED_SHARES:
        cost = 0.0
        for one in windows:
            grown_s = _grown(one.moving_s * one.growth, correlation_s) * (1.0 - share + share * one.intensity)
            variance = np.maximum(one.sensor * sensors + grown_s[:, None] * slips, 1e-12)
            cost += float((np.log(variance) + np.minimum(one.error**2 / variance, _LARGEST_SQUARE)).sum())
        costs.append(cost)
    return _SPEED_SHARES[int(np.argmin(costs))] if windows else 0.0


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


# Chosen: long enough for motion to show beside the sensor's noise.
_EXPLAINED_OVER_S = 1.0
_LEAST_MOTION = np.array([0.02, 0.02, 0.05])


def unexplained_share(drive: Excitation, theta: Array) -> float:
    """Return the share of the motion within a second that a geometry (3,) leaves unexplained.

    The larger one of position and yaw (root mean squares): near 0 for a sound log, about 1 for the poses of another
    drive.
    """
    error = _errors(drive, theta)
    lag = max(1, round(_EXPLAINED_OVER_S / float(np.median(np.diff(drive.t_s)[~drive.starts[1:]]))))
    left, moved, count = np.zeros(3), np.zeros(3), 0
    for lo, hi in _bounds(drive):
        left += ((error[lo + lag : hi] - error[lo : hi - lag]) ** 2).sum(axis=0)
        moved += ((drive.pose[lo + lag : hi] - drive.pose[lo : hi - lag]) ** 2).sum(axis=0)
        count += max(hi - lo - lag, 0)
    # Where hardly anything moves, what is left is the sensor's noise.
    moved = np.maximum(moved, count * _LEAST_MOTION**2)
    if not count:
        return 0.0
    return float(np.sqrt(max((left[0] + left[1]) / (moved[0] + moved[1]), left[2] / moved[2])))


def _without_jumps(error: Array) -> Array:
    """Errors (P, 3) with single values far from their neighbours' median put back on it."""
    middle = median_filter(error, size=(_NEIGHBOURS, 1), mode="nearest")
    apart = np.abs(error - middle)
    return np.where(apart > _JUMP * np.maximum(np.median(apart, axis=0), 1e-9), middle, error)


def _in_body(drive: Excitation, error: Array) -> tuple[Array, Array]:
    """Errors (P, 3) summed up along the body's own axes from the world's, and the squared turn so far (P,), rad^2.

    Over a second of turning, what slips forward would be counted to the left otherwise.
    """
    in_body, turned = np.zeros_like(error), np.zeros(error.shape[0])
    for lo, hi in _bounds(drive):
        yaw = drive.pose[lo:hi, 2]
        turn = np.diff(yaw)
        cosine, sine = np.cos(yaw[:-1] + 0.5 * turn), np.sin(yaw[:-1] + 0.5 * turn)
        x, y, off = np.diff(error[lo:hi], axis=0).T
        in_body[lo + 1 : hi] = np.cumsum(np.column_stack([x * cosine + y * sine, y * cosine - x * sine, off]), axis=0)
        turned[lo + 1 : hi] = np.cumsum(turn**2)
    return in_body, turned


def _windows(drive: Excitation, error: Array, turned: Array, by_speed_s: Array, lag: int) -> _Windows:
    """Windows of `lag` poses, from `_in_body`; `by_speed_s` (P,) as `slip_intensity` gives it for slip all by speed.

    From the mean of some poses to the mean of as many that are `lag` later, which quietens the sensor.
    """
    ends = max(1, round(_ENDS * lag))
    errors, moving, by_speed, turns = [np.empty((0, 3))], [np.empty(0)], [np.empty(0)], [np.empty(0)]
    stride = max(1, lag // 2)
    moved_s, grown_s = np.cumsum(drive.moving_s), np.cumsum(by_speed_s)
    for lo, hi in _bounds(drive):
        if hi - lo < lag + ends:
            continue
        start = np.arange(lo, hi - lag - ends + 1, stride)
        within = np.arange(ends)
        errors.append((error[start[:, None] + lag + within] - error[start[:, None] + within]).mean(axis=1))
        moving.append(moved_s[start + lag] - moved_s[start])
        by_speed.append(grown_s[start + lag] - grown_s[start])
        turns.append(turned[start + lag] - turned[start])
    moving_s = np.concatenate(moving)
    # A random walk from the mean of one end to that of the other grows by a third of an end less.
    growth = 1.0 - (ends - 1) / (3.0 * lag)
    # What the sensor adds to a position and takes off the next one does not cancel where the body has turned meanwhile.
    position = 2.0 / ends + growth * np.concatenate(turns)
    return _Windows(
        np.concatenate(errors),
        moving_s,
        np.concatenate(by_speed) / np.maximum(moving_s, 1e-9),
        growth,
        np.column_stack([position, position, np.full(moving_s.size, 2.0 / ends)]),
        0.0,
    )
