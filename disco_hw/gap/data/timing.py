"""How much earlier or later than the wheels the poses are stamped, found from the log alone before anything is fitted.

A search that begins without a delay of 0.3 s does not find it: it takes what the delay makes for slip and noise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Poses, Wheels

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_ROUNDS = 4
# Finer than any pose is measured; keeps a log without any noise finite.
_LEAST_SQUARE = 1e-10


def pose_delay_s(wheels: Wheels, poses: Poses, settings: GridSettings) -> float:
    """The delay at which poses and wheels agree best, s: positive where a pose is older than its time stamp.

    Scanned over +-`most_pose_delay_s`: for each delay the turns and ways between poses `delay_span_s` apart are fitted
    by those of the wheels (two regressions, robust by Huber's weights; their likelihoods, with unknown variances, are
    added). 0 where the poses are too few or where no delay stands out.
    """
    delays = settings.delay_step_s * np.arange(
        -round(settings.most_pose_delay_s / settings.delay_step_s),
        round(settings.most_pose_delay_s / settings.delay_step_s) + 1,
    )
    before, after = _pairs(poses, settings.delay_span_s)
    if wheels.t_s.size < 2 or before.size < settings.fewest_poses:
        return 0.0
    turn = np.remainder(poses.yaw_rad[after] - poses.yaw_rad[before] + np.pi, 2.0 * np.pi) - np.pi
    heading = poses.yaw_rad[before] + 0.5 * turn
    way = (poses.x_m[after] - poses.x_m[before]) * np.cos(heading)
    way += (poses.y_m[after] - poses.y_m[before]) * np.sin(heading)
    begin, end = _bounds(wheels, poses.segment[before])
    misfit = np.full(delays.size, np.inf)
    for place, delay in enumerate(delays):
        start, stop = poses.t_s[before] - delay, poses.t_s[after] - delay
        known = (start >= begin) & (stop <= end)
        if np.count_nonzero(known) < settings.fewest_poses:
            continue
        left, right = (
            np.interp(stop[known], wheels.t_s, angle) - np.interp(start[known], wheels.t_s, angle)
            for angle in (wheels.left_angle_rad, wheels.right_angle_rad)
        )
        columns = np.column_stack([right - left, right + left])
        misfit[place] = _misfit(columns, turn[known]) + _misfit(columns, way[known])
    best = int(np.argmin(misfit))
    ordinary = misfit[np.isfinite(misfit)]
    if not ordinary.size or float(np.median(ordinary)) - misfit[best] < settings.least_delay_nats:
        return 0.0
    return float(delays[best] + settings.delay_step_s * _vertex(misfit, best))


def _pairs(poses: Poses, span_s: float) -> tuple[Index, Index]:
    """Pairs of poses of one segment that lie `span_s` apart, or little more."""
    later = np.searchsorted(poses.t_s, poses.t_s + span_s - 1e-9)
    first = np.flatnonzero(later < poses.t_s.size)
    second = later[first]
    near = (poses.segment[first] == poses.segment[second]) & (poses.t_s[second] - poses.t_s[first] < 1.6 * span_s)
    return first[near], second[near]


def _bounds(wheels: Wheels, segment: Index) -> tuple[Array, Array]:
    """First and last time of the wheels' samples in some segments; an empty span where there are none."""
    segments = np.unique(segment)
    begin, end = np.full(segments.size, np.inf), np.full(segments.size, -np.inf)
    for place, number in enumerate(segments):
        times = wheels.t_s[wheels.segment == number]
        if times.size:
            begin[place], end[place] = times[0], times[-1]
    at = np.searchsorted(segments, segment)
    return begin[at], end[at]


def _misfit(columns: Array, measured: Array) -> float:
    """Minus the log likelihood per sample of a robust regression whose variance is unknown."""
    weight = np.ones(measured.size)
    for _ in range(_ROUNDS):
        fitted = np.linalg.lstsq(columns * weight[:, None], measured * weight, rcond=None)[0]
        left = np.abs(measured - columns @ fitted)
        limit = 2.0 * 1.4826 * float(np.median(left)) + 1e-9
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-12)))
    loss = np.where(left < limit, left**2, limit * (2.0 * left - limit))
    return 0.5 * float(np.log(loss.mean() + _LEAST_SQUARE))


def _vertex(values: Array, least: int) -> float:
    """Where the parabola through the least of some values and its neighbours has its vertex, in places from it."""
    if not 0 < least < values.size - 1 or not np.isfinite(values[least - 1 : least + 2]).all():
        return 0.0
    low, mid, high = values[least - 1 : least + 2]
    bend = low - 2.0 * mid + high
    return float(0.5 * (low - high) / bend) if bend > 0.0 else 0.0
