"""Free runs of one channel at a time: wheels from commands alone, body from measured wheel angles alone.

The equations are the model's own step, fed with what was measured where the chain is cut. From a run come the residuals
of poses in windows, and predictions some seconds ahead from a known pose, as displacement in the frame of the start.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data import BODY, DELAYED_BY, WHEEL, body_effects, counted, pose_sensor, wheel_effects
from disco_hw.gap.settings import GRID_STEP_S, GridSettings
from disco_hw.jit import kernel_function, scalar_function
from disco_hw.model.step import body_velocity, wheel_step

# Half a turn in one cell that a short series is exact for: 20 rad/s of yaw rate.
_SMALL_RAD = 0.1

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@scalar_function
def _at(command: Any, place: int, part: float, begin: int, end: int, side: int) -> Any:
    """Command at a cell and a part of the next; before the run's first and after its last it is that one."""
    low = min(max(place, begin), end)
    if part == 0.0:
        return command[low, side]
    high = min(max(place + 1, begin), end)
    return command[low, side] + part * (command[high, side] - command[low, side])


@kernel_function
def _run_wheels(
    effects: Any, delay_cells: float, command: Array, extra: Array, first: Mask, t_s: Array, start: Array, angle: Array
) -> None:
    earlier = math.floor(-delay_cells)
    part = -delay_cells - earlier
    begin = end = 0
    left_speed, right_speed = 0.0, 0.0
    known = False
    for i in range(command.shape[0]):
        if i > end or i == 0:
            end = i
            while end + 1 < command.shape[0] and not first[end + 1]:
                end += 1
        if first[i] or not known:
            begin = i
            angle[i, 0] = 0.0 if first[i] else angle[i - 1, 0]
            angle[i, 1] = 0.0 if first[i] else angle[i - 1, 1]
            left_speed, right_speed = start[i, 0], start[i, 1]
            known = not math.isnan(command[i, 0])
            continue
        cell = i - 1
        place = cell + earlier
        left, right = _at(command, place, part, begin, end, 0), _at(command, place, part, begin, end, 1)
        if math.isnan(command[cell, 0]) or math.isnan(left) or math.isnan(right):
            known = False
            angle[i, 0], angle[i, 1] = angle[i - 1, 0], angle[i - 1, 1]
            continue
        left_speed, right_speed, mean_left, mean_right = wheel_step(
            left + extra[cell, 0], right + extra[cell, 1], left_speed, right_speed, t_s[cell], effects, None, 0, 0
        )
        angle[i, 0] = angle[i - 1, 0] + GRID_STEP_S * mean_left
        angle[i, 1] = angle[i - 1, 1] + GRID_STEP_S * mean_right


@scalar_function
def _turned(cosine: float, sine: float, half: float) -> tuple[float, float]:
    """Cosine and sine of an angle to which a small one is added; exact to rounding below `_SMALL_RAD`."""
    q = half * half
    c = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q / 40320.0)))
    s = half * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@kernel_function
def _run_body(
    base: Any, effects: Any, scale: Any, angle: Array, speed: Array, extra: Array, first: Mask, t_s: Array, track: Array
) -> None:
    x = y = yaw = 0.0
    c, s = 1.0, 0.0
    for i in range(angle.shape[0]):
        if first[i]:
            x = y = yaw = 0.0
            c, s = 1.0, 0.0
        else:
            left = (angle[i, 0] - angle[i - 1, 0]) * scale[0] / GRID_STEP_S
            right = (angle[i, 1] - angle[i - 1, 1]) * scale[1] / GRID_STEP_S
            change = scale[0] * (speed[i, 0] - speed[i - 1, 0]) + scale[1] * (speed[i, 1] - speed[i - 1, 1])
            forward, lateral, half_rate = body_velocity(
                left + right, right - left, change, t_s[i - 1], base, effects, None, 0, 0
            )
            turn = (2.0 * half_rate + extra[i - 1, 2]) * GRID_STEP_S
            along = (forward + extra[i - 1, 0]) * GRID_STEP_S
            across = (lateral + extra[i - 1, 1]) * GRID_STEP_S - base.x_icr_m * turn
            half = 0.5 * turn
            small = abs(half) < _SMALL_RAD
            if small:
                cosine, sine = _turned(c, s, half)
            else:
                cosine, sine = math.cos(yaw + half), math.sin(yaw + half)
            x += cosine * along - sine * across
            y += sine * along + cosine * across
            yaw += turn
            c, s = _turned(cosine, sine, half) if small else (math.cos(yaw), math.sin(yaw))
        track[i, 0], track[i, 1], track[i, 2] = x, y, yaw


def run_wheels(
    p: Array, geometry: Array, command: Array, extra: Array, first: Mask, t_s: Array, start: Array, moved_s: float = 0.0
) -> Array:
    """Measured wheel angles (M, 2) that the commands alone make.

    `p` in the order of `WHEEL.columns`; `command` (M, 2) rad/s per cell, NaN begins anew; `extra` (M, 2) is added to
    the command; `start` (M, 2) measured speeds, read where a run begins; `geometry` (3,). The commands lie `moved_s`
    later than they are stamped.
    """
    angle = np.empty_like(command)
    delay_cells = (WHEEL.at(p, DELAYED_BY) - moved_s) / GRID_STEP_S
    _run_wheels(wheel_effects(p, geometry), delay_cells, command, extra, first, t_s, start, angle)
    turns = counted(WHEEL, p)
    if turns != (1.0, 1.0):
        angle *= turns
    return angle


def run_body(p: Array, angle: Array, speed: Array, extra: Array, first: Mask, t_s: Array) -> Array:
    """Path x, y, yaw (M, 3) of the tracked point from measured wheel angles and speeds (M, 2), each run from 0.

    `p` in the order of `BODY.columns`; `extra` (M, 3) is added to forward, left (m/s) and yaw rate (rad/s). Drift in
    the world, latency and heading bias are not in here: they act when the path is laid on the measured poses.
    """
    track = np.empty((angle.shape[0], 3))
    base, effects = body_effects(p)
    turns = counted(BODY, p)
    scale = (1.0 / turns[0], 1.0 / turns[1])
    _run_body(base, effects, scale, angle, speed, extra, first, t_s, track)
    sensor = pose_sensor(p)
    left, forward = sensor.left_m, sensor.forward_m
    if left != 0.0 or forward != 0.0:
        cosine, sine = np.cos(track[:, 2]), np.sin(track[:, 2])
        track[:, 0] += forward * cosine - left * sine
        track[:, 1] += forward * sine + left * cosine
    return track


@kernel_function
def read_angles(angle: Array, node: Index, fraction: Array, out: Array) -> None:
    """Values (S, columns) between nodes, on straight lines."""
    for k in range(node.shape[0]):
        low, part = node[k], fraction[k]
        for column in range(out.shape[1]):
            out[k, column] = angle[low, column] + part * (angle[low + 1, column] - angle[low, column])


@kernel_function
def _propagate(
    delay_cells: float, bias: float, ground: Array, track: Array, node: Index,
    fraction: Array, window: Index, first_node: Index, last_node: Index, use: Mask, measured: Array, out: Array,
) -> None:  # fmt: skip
    count = node.shape[0]
    begin = 0
    while begin < count:
        end = begin
        turned = used = 0.0
        while end < count and window[end] == window[begin]:
            place = min(max(node[end] + fraction[end] - delay_cells, float(first_node[end])), last_node[end] - 1e-6)
            low = math.floor(place)
            part = place - low
            for column in range(3):
                out[end, column] = track[low, column] + part * (track[low + 1, column] - track[low, column])
            out[end, 2] += bias
            if use[end]:
                turned += measured[end, 2] - out[end, 2]
                used += 1.0
            end += 1
        turned /= max(used, 1.0)
        cosine, sine = math.cos(turned), math.sin(turned)
        mean_x = mean_y = 0.0
        for k in range(begin, end):
            place = min(max(node[k] + fraction[k] - delay_cells, float(first_node[k])), last_node[k] - 1e-6)
            low = math.floor(place)
            part = place - low
            moved_x = ground[low, 0] + part * (ground[low + 1, 0] - ground[low, 0])
            moved_y = ground[low, 1] + part * (ground[low + 1, 1] - ground[low, 1])
            x = cosine * out[k, 0] - sine * out[k, 1] + moved_x
            y = sine * out[k, 0] + cosine * out[k, 1] + moved_y
            out[k, 0], out[k, 1] = measured[k, 0] - x, measured[k, 1] - y
            out[k, 2] = measured[k, 2] - out[k, 2] - turned
            if use[k]:
                mean_x += out[k, 0] / used
                mean_y += out[k, 1] / used
        for k in range(begin, end):
            out[k, 0] -= mean_x
            out[k, 1] -= mean_y
        begin = end


def pose_residual(
    p: Array, track: Array, ground: Array, node: Index, fraction: Array, window: Index, first_node: Index,
    last_node: Index, use: Mask, measured: Array, moved_s: float = 0.0,
) -> Array:  # fmt: skip
    """Measured minus predicted pose (P, 3) in the world frame, each window laid on its measurements.

    `window` (P,) numbers ascending from 0; within one the predicted path is turned and shifted as a whole by the mean
    difference over the samples in `use`. `ground` (M, 2) is how far the ground has carried the robot (m); `first_node`,
    `last_node` (P,) bound the run of each sample, for the latency. The poses lie `moved_s` earlier than they
    are stamped.
    """
    out = np.empty_like(measured)
    sensor = pose_sensor(p)
    delay_cells = (sensor.delay_s - moved_s) / GRID_STEP_S
    _propagate(
        delay_cells, sensor.bias_rad, ground, track, node, fraction, window, first_node, last_node, use, measured, out
    )
    return out


@kernel_function
def _displace(
    p: Any, track: Any, ground: Any, start: Any, low: Any, high: Any, heading: Any, ahead: int, out: Any
) -> None:
    delay_cells = p[0] / GRID_STEP_S
    top = track.shape[0] - 2
    for k in range(start.shape[0]):
        a = max(start[k] - delay_cells, float(low[k]))
        b = max(start[k] + ahead - delay_cells, float(low[k]))
        # Poses that are true later than stamped may be so after the run's end: the last speed is kept.
        i, j = min(math.floor(a), high[k] - 1), min(math.floor(b), high[k] - 1)
        f, g = a - i, b - j
        x = track[j, 0] + g * (track[j + 1, 0] - track[j, 0]) - track[i, 0] - f * (track[i + 1, 0] - track[i, 0])
        y = track[j, 1] + g * (track[j + 1, 1] - track[j, 1]) - track[i, 1] - f * (track[i + 1, 1] - track[i, 1])
        yaw_start = track[i, 2] + f * (track[i + 1, 2] - track[i, 2])
        yaw = track[j, 2] + g * (track[j + 1, 2] - track[j, 2])
        # The measured heading is the true one plus the bias: displacement is given in the measured frame.
        turned = yaw_start + p[1]
        cosine, sine = math.cos(turned), math.sin(turned)
        end = min(start[k] + ahead, top)
        moved_x, moved_y = ground[end, 0] - ground[start[k], 0], ground[end, 1] - ground[start[k], 1]
        c, s = math.cos(heading[k]), math.sin(heading[k])
        out[k, 0] = cosine * x + sine * y + c * moved_x + s * moved_y
        out[k, 1] = -sine * x + cosine * y - s * moved_x + c * moved_y
        out[k, 2] = yaw - yaw_start


def displacement(
    p: Array, first: NDArray[np.bool_], track: Array, ground: Array, start: Index, heading_rad: Array, ahead_s: float,
    moved_s: float = 0.0,
) -> Array:  # fmt: skip
    """Forward, left and yaw (K, 3) that a pose sensor would see from each start node to `ahead_s` later.

    `p` in the order of `BODY.columns`; `first` (M,) where runs begin, out of which no latency looks; `track` (M, 3) a
    free run of the body, `ground` (M, 2) how far the ground has carried it; `heading_rad` (K,) measured there. The
    poses lie `moved_s` earlier than they are stamped.
    """
    begins = np.flatnonzero(first)
    run = np.searchsorted(begins, start, side="right") - 1
    low, high = begins[run], np.append(begins[1:], first.size)[run] - 1
    out = np.empty((start.size, 3))
    sensor = pose_sensor(p)
    world = np.array([sensor.delay_s - moved_s, sensor.bias_rad])
    # A strided column is another type, for which it would be compiled once more.
    heading = np.ascontiguousarray(heading_rad)
    _displace(world, track, ground, start, low, high, heading, round(ahead_s / GRID_STEP_S), out)
    return out


def rotated(moved: Array, angle: Array) -> Array:
    """Turn displacements (n, 2) counter-clockwise by angles (n,), in rad."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.column_stack([cosine * moved[:, 0] - sine * moved[:, 1], sine * moved[:, 0] + cosine * moved[:, 1]])


def starts_of(first: NDArray[np.bool_], usable: NDArray[np.bool_], ahead_s: float, settings: GridSettings) -> Index:
    """Nodes (K,), `start_every_s` apart, from which a prediction stays within its run and on usable nodes."""
    ahead, stride = round(ahead_s / GRID_STEP_S), round(settings.start_every_s / GRID_STEP_S)
    begins = np.flatnonzero(first)
    ends = np.append(begins[1:], first.size)
    # What was commanded before a run is not known, and late wheels still follow it.
    lead = np.minimum(round(settings.lead_s / GRID_STEP_S), (settings.lead_share * (ends - begins)).astype(np.int64))
    bad = np.concatenate([[0], np.cumsum(~usable)])
    found = [np.arange(lo + at, hi - ahead - 1, stride) for lo, at, hi in zip(begins, lead, ends, strict=True)]
    start = np.concatenate(found) if found else np.empty(0, dtype=np.int64)
    return np.asarray(start[bad[start + ahead + 1] == bad[start]])


def starts_as_far_as(
    first: NDArray[np.bool_], usable: NDArray[np.bool_], ahead_s: float, settings: GridSettings
) -> tuple[Index, float]:
    """Nodes (K,) where predictions start, and their length, `ahead_s`, or half or a quarter if none reaches so far."""
    for share in (1.0, 0.5, 0.25):
        start = starts_of(first, usable, share * ahead_s, settings)
        if start.size:
            break
    return start, share * ahead_s
