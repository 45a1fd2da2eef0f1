"""Predictions some seconds ahead from a known pose, as displacement in the frame of the start."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.layout import pose_sensor
from disco_hw.gap.settings import GRID_STEP_S, GridSettings
from disco_hw.jit import kernel_function

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@kernel_function
def _displace(
    p: Any, track: Any, moving_s: Any, start: Any, low: Any, high: Any, heading: Any, ahead: int, out: Any
) -> None:
    late = p[0] / GRID_STEP_S
    top = track.shape[0] - 2
    for k in range(start.shape[0]):
        a = max(start[k] - late, float(low[k]))
        b = max(start[k] + ahead - late, float(low[k]))
        # Poses that are true later than stamped may be so after the run's end: the last speed is kept.
        i, j = min(math.floor(a), high[k] - 1), min(math.floor(b), high[k] - 1)
        f, g = a - i, b - j
        x = track[j, 0] + g * (track[j + 1, 0] - track[j, 0]) - track[i, 0] - f * (track[i + 1, 0] - track[i, 0])
        y = track[j, 1] + g * (track[j + 1, 1] - track[j, 1]) - track[i, 1] - f * (track[i + 1, 1] - track[i, 1])
        yaw_start = track[i, 2] + f * (track[i + 1, 2] - track[i, 2])
        yaw = track[j, 2] + g * (track[j + 1, 2] - track[j, 2])
        # The measured heading is the true one plus the bias: displacement is told in the measured frame.
        turned = yaw_start + p[1]
        cosine, sine = math.cos(turned), math.sin(turned)
        moved = moving_s[min(start[k] + ahead, top)] - moving_s[start[k]]
        c, s = math.cos(heading[k]), math.sin(heading[k])
        out[k, 0] = cosine * x + sine * y + (c * p[2] + s * p[3]) * moved
        out[k, 1] = -sine * x + cosine * y + (-s * p[2] + c * p[3]) * moved
        out[k, 2] = yaw - yaw_start


def displacement(
    p: Array, first: NDArray[np.bool_], track: Array, moving_s: Array, start: Index, heading_rad: Array, ahead_s: float
) -> Array:
    """Forward, left and yaw (K, 3) that a pose sensor would see from each start node to `ahead_s` later.

    `p` in the order of `BODY.columns`; `first` (M,) where runs begin, out of which no latency looks; `track` (M, 3) a
    free run of the body; `heading_rad` (K,) measured there.
    """
    begins = np.flatnonzero(first)
    run = np.searchsorted(begins, start, side="right") - 1
    low, high = begins[run], np.append(begins[1:], first.size)[run] - 1
    out = np.empty((start.size, 3))
    sensor = pose_sensor(p)
    world = np.array([sensor.late_s, sensor.bias_rad, sensor.drift_x_m_s, sensor.drift_y_m_s])
    _displace(world, track, moving_s, start, low, high, heading_rad, round(ahead_s / GRID_STEP_S), out)
    return out


def starts_of(first: NDArray[np.bool_], usable: NDArray[np.bool_], ahead_s: float, settings: GridSettings) -> Index:
    """Nodes (K,), `start_every_s` apart, from which a prediction stays within its run and on usable nodes."""
    ahead, stride = round(ahead_s / GRID_STEP_S), round(settings.start_every_s / GRID_STEP_S)
    # What was commanded before a run is not known, and late wheels still follow it.
    lead = round(settings.lead_s / GRID_STEP_S)
    begins = np.flatnonzero(first)
    ends = np.append(begins[1:], first.size)
    bad = np.concatenate([[0], np.cumsum(~usable)])
    found = [np.arange(lo + lead, hi - ahead - 1, stride) for lo, hi in zip(begins, ends, strict=True)]
    start = np.concatenate(found) if found else np.empty(0, dtype=np.int64)
    return np.asarray(start[bad[start + ahead + 1] == bad[start]])
