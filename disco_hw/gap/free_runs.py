"""Free runs of one channel at a time: wheels from commands alone, body from measured wheel angles alone.

All effects of a channel are in one compiled function; at its neutral value an effect changes nothing. That way no set
of effects needs a compilation of its own. Their equations are the model's, on the measured inputs of the channel
(`tests/gap/test_free_runs.py` holds the two against each other).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from disco_hw.gap.timeline import CELL_S

Array = NDArray[np.float64]

WHEEL = (
    "tau_s",
    "delay_s",
    "deadband_rad_s",
    "stiction_rad_s",
    "speed_limit_rad_s",
    "turn_limit_rad_s",
    "sag_per_s",
    "gain_left",
    "gain_right",
)
WHEEL_NEUTRAL = np.array([0.0, 0.0, 0.0, 0.0, 1e3, 1e3, 0.0, 0.0, 0.0])

BODY = (
    "wheel_radius_m",
    "axial_distance_m",
    "x_icr_m",
    "asymmetry",
    "turn_slip_s",
    "acceleration_slip_s2_m",
    "side_slip_s",
    "lateral_icr_m",
    "drift_x_m_s",
    "drift_y_m_s",
    "change_track",
    "change_radius",
    "change_time_s",
    "latency_s",
    "heading_bias_rad",
)
BODY_NEUTRAL = np.array([0.06, 0.4, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1e9, 0.0, 0.0])

REST_RAD_S = 0.02
LEAST_TURN_LEFT = 0.5


def _compiled(function: Any) -> Any:
    return njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})(function)


@_compiled
def _at(command: Array, node: int, begin: int, late_cells: float, side: int) -> float:
    """Command of the cell at `node`, `late_cells` earlier; before the run's first it is that one."""
    place = node - late_cells
    below = int(math.floor(place))
    part = place - below
    low = min(max(below, begin), command.shape[0] - 1)
    high = min(max(below + 1, begin), command.shape[0] - 1)
    return float(command[low, side] + part * (command[high, side] - command[low, side]))


@_compiled
def run_wheels(p: Array, command: Array, extra: Array, first: Array, t_s: Array, start: Array, angle: Array) -> None:
    """Wheel angles (M, 2) from commands alone.

    `p` in the order of `WHEEL`; `command` (M, 2) rad/s per cell, NaN begins anew; `extra` (M, 2) is added to the
    handled command; `start` (M, 2) measured speeds, read where a run begins.
    """
    late = p[1] / CELL_S
    kept = math.exp(-CELL_S / p[0]) if p[0] > 1e-6 else 0.0
    kept_mean = (1.0 - kept) * p[0] / CELL_S
    begin = 0
    speed = np.zeros(2)
    stuck = np.zeros(2)
    reference = np.zeros(2)
    known = False
    for i in range(command.shape[0]):
        if first[i] or not known:
            begin = i
            angle[i, 0], angle[i, 1] = (0.0, 0.0) if first[i] else (angle[i - 1, 0], angle[i - 1, 1])
            for side in range(2):
                speed[side] = start[i, side]
                stuck[side] = 1.0 if abs(speed[side]) < REST_RAD_S else 0.0
            known = not math.isnan(command[i, 0])
            continue
        cell = i - 1
        left = _at(command, cell, begin, late, 0)
        right = _at(command, cell, begin, late, 1)
        if math.isnan(command[cell, 0]) or math.isnan(left) or math.isnan(right):
            known = False
            angle[i, 0], angle[i, 1] = angle[i - 1, 0], angle[i - 1, 1]
            continue
        left = math.copysign(max(abs(left) - p[2], 0.0), left)
        right = math.copysign(max(abs(right) - p[2], 0.0), right)
        half = 0.5 * (right - left)
        if abs(half) > p[5]:
            mean = 0.5 * (left + right)
            half = math.copysign(p[5], half)
            left, right = mean - half, mean + half
        supply = 1.0 - p[6] * t_s[cell]
        reference[0] = min(max(left, -p[4]), p[4]) * (1.0 + p[7]) * supply + extra[cell, 0]
        reference[1] = min(max(right, -p[4]), p[4]) * (1.0 + p[8]) * supply + extra[cell, 1]
        for side in range(2):
            target = reference[side]
            before = speed[side]
            if p[3] > 0.0:
                if stuck[side] > 0.0 and abs(target) <= p[3]:
                    target = 0.0
                else:
                    stuck[side] = 0.0
            after = target + (before - target) * kept
            angle[i, side] = angle[i - 1, side] + CELL_S * (target + (before - target) * kept_mean)
            if p[3] > 0.0 and abs(reference[side]) <= p[3]:
                if abs(after) < REST_RAD_S or before * after < 0.0:
                    stuck[side] = 1.0
                    after = 0.0
            speed[side] = after


@_compiled
def run_body(p: Array, angle: Array, speed: Array, extra: Array, first: Array, t_s: Array, track: Array) -> None:
    """Path x, y, yaw (M, 3) of the tracked point from measured wheel angles, each run from the origin.

    `p` in the order of `BODY`; `extra` (M, 3) is added to forward, left (m/s) and yaw rate (rad/s). Drift, latency and
    heading bias are not in here: they belong to the world and to the sensor.
    """
    x = y = yaw = 0.0
    push = 0.0
    for i in range(angle.shape[0]):
        changed = t_s[i] >= p[12]
        radius = p[0] * (1.0 + p[11]) if changed else p[0]
        axial = p[1] * (1.0 + p[10]) if changed else p[1]
        r_left, r_right = radius * (1.0 - p[3]), radius * (1.0 + p[3])
        v = 0.5 * (r_right * speed[i, 1] + r_left * speed[i, 0])
        omega = (r_right * speed[i, 1] - r_left * speed[i, 0]) / axial
        push_before = push
        push = 0.5 * p[5] * v * abs(v)
        if first[i]:
            x = y = yaw = 0.0
        else:
            d_left, d_right = r_left * (angle[i, 0] - angle[i - 1, 0]), r_right * (angle[i, 1] - angle[i - 1, 1])
            kept = min(max(1.0 - p[4] * abs(omega), LEAST_TURN_LEFT), 1.0 / LEAST_TURN_LEFT)
            turn = (d_right - d_left) / axial * kept
            # Slip in proportion to |v| dv/dt adds up to the change of v|v|/2: no speed is differentiated.
            along = 0.5 * (d_left + d_right) - (push - push_before) + p[7] * turn + extra[i - 1, 0] * CELL_S
            across = -(p[2] + p[6] * v) * turn + extra[i - 1, 1] * CELL_S
            turn += extra[i - 1, 2] * CELL_S
            middle = yaw + 0.5 * turn
            cosine, sine = math.cos(middle), math.sin(middle)
            x += cosine * along - sine * across
            y += sine * along + cosine * across
            yaw += turn
        track[i, 0], track[i, 1], track[i, 2] = x, y, yaw


@_compiled
def read_angles(angle: Array, node: Array, fraction: Array, out: Array) -> None:
    """Values (S, columns) between nodes, on straight lines."""
    for k in range(node.shape[0]):
        low, part = node[k], fraction[k]
        for column in range(out.shape[1]):
            out[k, column] = angle[low, column] + part * (angle[low + 1, column] - angle[low, column])


@_compiled
def pose_residual(
    p: Array,
    track: Array,
    moving_s: Array,
    node: Array,
    fraction: Array,
    window: Array,
    first_node: Array,
    last_node: Array,
    use: Array,
    measured: Array,
    out: Array,
) -> None:
    """Measured minus predicted pose (P, 3) in the world frame, each window laid on its measurements.

    `window` (P,) numbers ascending from 0; within one the predicted path is turned and shifted as a whole by the mean
    difference over the samples in `use`. `moving_s` (M,) is the time in motion, for the drift; `first_node`,
    `last_node` (P,) bound the run of each sample, for the latency.
    """
    late = p[13] / CELL_S
    count = node.shape[0]
    begin = 0
    while begin < count:
        end = begin
        turned = 0.0
        used = 0.0
        while end < count and window[end] == window[begin]:
            place = min(max(node[end] + fraction[end] - late, float(first_node[end])), last_node[end] - 1e-6)
            low = int(math.floor(place))
            part = place - low
            for column in range(3):
                out[end, column] = track[low, column] + part * (track[low + 1, column] - track[low, column])
            moved = moving_s[low] + part * (moving_s[low + 1] - moving_s[low])
            out[end, 2] += p[14]
            if use[end]:
                turned += measured[end, 2] - out[end, 2]
                used += 1.0
            end += 1
        if used == 0.0:
            for k in range(begin, end):
                out[k, 0] = out[k, 1] = out[k, 2] = 0.0
            begin = end
            continue
        turned /= used
        cosine, sine = math.cos(turned), math.sin(turned)
        mean_x = mean_y = 0.0
        for k in range(begin, end):
            place = min(max(node[k] + fraction[k] - late, float(first_node[k])), last_node[k] - 1e-6)
            low = int(math.floor(place))
            moved = moving_s[low] + (place - low) * (moving_s[low + 1] - moving_s[low])
            x = cosine * out[k, 0] - sine * out[k, 1] + p[8] * moved
            y = sine * out[k, 0] + cosine * out[k, 1] + p[9] * moved
            out[k, 0], out[k, 1] = measured[k, 0] - x, measured[k, 1] - y
            out[k, 2] = measured[k, 2] - out[k, 2] - turned
            if use[k]:
                mean_x += out[k, 0] / used
                mean_y += out[k, 1] / used
        for k in range(begin, end):
            out[k, 0] -= mean_x
            out[k, 1] -= mean_y
        begin = end
