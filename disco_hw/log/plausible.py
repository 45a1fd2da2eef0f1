"""Whether a drive's numbers can be in the units they claim; pure functions of arrays.

A log in degrees, millimetres or milliseconds gives a posterior as readily as a good one, so what cannot be is refused.
The bounds are wide: they tell units apart, not good robots from bad ones.
"""

from __future__ import annotations

import numpy as np

from disco_hw.log.drive import Array, Commands, Index, Poses, Wheels, integrate_angle

_LONGEST_PERIOD_S = 2.0
_SHORTEST_PERIOD_S = 1e-4
_WHEEL_RADIUS_M = (0.005, 1.5)
_AGAINST_NOMINAL = 4.0
_STANDS_STILL = 100.0
_CHORD_ROLL_RAD = 2.0
_ENOUGH_CHORDS = 5
_LARGEST_TURN_RATIO = 3.0
_LARGEST_YAW_RATE_RAD_S = 6.0


def time_fault(t_s: Array) -> str | None:
    """What is wrong with times that should be in seconds, or None."""
    if t_s.size < 3:
        return None
    period_s = float(np.median(np.diff(t_s)))
    if _SHORTEST_PERIOD_S <= period_s <= _LONGEST_PERIOD_S:
        return None
    return f"t_s: {period_s:.3g} from row to row, which does not look like seconds; write seconds"


def yaw_fault(t_s: Array, yaw_rad: Array, segment: Index, wheels: Wheels, commands: Commands) -> str | None:
    """Whether yaw, as written in the file, looks like degrees: field, fault and remedy, or None.

    Yaw that stays within (-pi, pi] is taken as it is. Beyond, it may be radians that were not wrapped: they turn no
    more than the wheels can make them (yaw change <= difference of the wheels' roll x radius / axial distance).
    """
    if not yaw_rad.size or np.abs(yaw_rad).max() <= np.pi + 0.01:
        return None
    steps = np.diff(yaw_rad)
    usual = np.diff(segment) == 0
    turned = float(np.abs(steps[usual]).sum())
    _, roll = _roll(wheels, commands)
    if roll.size:
        possible = _LARGEST_TURN_RATIO * float(np.abs(np.diff(roll[:, 1] - roll[:, 0])).sum()) + np.pi
        degrees = turned > possible
    else:
        rate = np.abs(steps[usual] / np.diff(t_s)[usual])
        degrees = bool(rate.size) and float(np.quantile(rate, 0.9)) > _LARGEST_YAW_RATE_RAD_S
    if not degrees:
        return None
    return f"pose_yaw_rad: {turned:.0f} rad of turning is more than the wheels can do, like degrees; write radians"


def length_fault(poses: Poses, wheels: Wheels, commands: Commands, wheel_radius_m: float | None) -> str | None:
    """Whether path and roll of the wheels give an impossible wheel radius: field, fault and remedy, or None.

    The path is the sum of chords between poses that are 2 rad of forward roll apart, so that neither noise at rest nor
    turning on the spot counts. `wheel_radius_m` is the nominal radius if known; within a factor of 4 is believed.
    """
    roll_t_s, roll = _roll(wheels, commands)
    if poses.t_s.size < 2 or not roll.size:
        return None
    forward = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(roll.mean(axis=1))))))
    at_pose = np.interp(poses.t_s, roll_t_s, forward)
    _, picked = np.unique(np.floor(at_pose / _CHORD_ROLL_RAD), return_index=True)
    inside = np.diff(poses.segment[picked]) == 0
    if np.count_nonzero(inside) < _ENOUGH_CHORDS:
        return None
    path_m = float(np.hypot(np.diff(poses.x_m[picked]), np.diff(poses.y_m[picked]))[inside].sum())
    roll_rad = float(np.diff(at_pose[picked])[inside].sum())
    radius_m = path_m / roll_rad
    low, high = _WHEEL_RADIUS_M
    if wheel_radius_m is not None:
        low, high = wheel_radius_m / _AGAINST_NOMINAL, wheel_radius_m * _AGAINST_NOMINAL
    # Poses that do not move at all are lifted wheels or a dead sensor, not a unit.
    if low <= radius_m <= high or radius_m < low / _STANDS_STILL:
        return None
    fault = f"{path_m:.3g} m of path for {roll_rad:.3g} rad of wheel would be a wheel radius of {radius_m:.2g} m"
    return f"pose_x_m, pose_y_m against the wheels: {fault}; write metres, rad/s and the encoder's true ticks_per_rev"


def _roll(wheels: Wheels, commands: Commands) -> tuple[Array, Array]:
    """Times (N,) and cumulative wheel angles (N, 2), from the commands where no wheels were measured."""
    if wheels.t_s.size:
        return wheels.t_s, np.column_stack([wheels.left_angle_rad, wheels.right_angle_rad])
    t_s, segment = commands.t_s, commands.segment
    left, right = np.nan_to_num(commands.left_rad_s), np.nan_to_num(commands.right_rad_s)
    return t_s, np.column_stack([integrate_angle(t_s, left, segment), integrate_angle(t_s, right, segment)])
