"""Wheel speeds that a log repeats until the next one comes, as samples at the times when they were new.

Robots report wheel speed at 4 to 10 Hz and logs hold the last value. A speed that comes at the end of its interval
speaks of the time before it: laid on that, the angle is neither late nor smooth beyond what was measured.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Wheels

Array = NDArray[np.float64]


def undo_sample_hold(wheels: Wheels, settings: GridSettings) -> Wheels:
    """The wheels' samples without repeated ones, angles integrated backwards; unchanged where nothing is held.

    Held are speeds from which the angles were derived, if the log repeats more than a third of those of turning wheels.
    """
    if wheels.angle_measured or wheels.t_s.size < 3:
        return wheels
    speed = np.column_stack([wheels.left_speed_rad_s, wheels.right_speed_rad_s])
    same_run = np.diff(wheels.segment) == 0
    repeated = (np.diff(speed, axis=0) == 0.0).all(axis=1) & same_run
    turning = (np.abs(speed[1:]) > settings.held_turning_rad_s).any(axis=1)
    if turning.sum() < 20 or float(repeated[turning].mean()) < settings.held_share:
        return wheels
    new = np.concatenate([[True], ~repeated])
    period_s = float(np.median(np.diff(wheels.t_s[new])))
    keep, last_s = new.copy(), wheels.t_s[0]
    # Wheels that rest repeat their zeros: those are measured too, as often as the robot measures.
    for k in range(1, wheels.t_s.size):
        if not keep[k] and wheels.t_s[k] - last_s > settings.held_periods * period_s:
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
