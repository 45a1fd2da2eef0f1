"""The headings in which a robot keeps its tracked point on a line: the stable inverse of its motion.

The tracked point lies `x_icr_m` behind the centre of rotation and slides sideways by -omega x_icr as the robot turns.
To keep it on a line of direction phi the heading must obey d yaw / d s = sin(yaw - phi) / x_icr, which runs away along
the line and settles against it: so it is worked out from the line's end to its beginning, and a robot begins to turn
before the line does (Devasia, Chen, Paden, "Nonlinear inversion-based output tracking", 1996).
"""

from __future__ import annotations

import math

import numpy as np

from disco_hw.tasks.task import Array

SMALLEST_X_ICR_M = 0.01
_LAPS = 3


def stable_yaw(along_rad: Array, spacing_m: float, x_icr_m: float, closed: bool) -> Array:
    """Heading (M + 1,) at the begin of each of M pieces of these directions, and at the end of the last.

    `along_rad` (M,) is unwrapped; the heading of a closed line repeats, that of any other ends along it. Below
    SMALLEST_X_ICR_M the tracked point goes where the robot heads.
    """
    if abs(x_icr_m) < SMALLEST_X_ICR_M:
        return np.append(along_rad, along_rad[-1])
    if x_icr_m < 0.0:
        # With the centre of rotation behind, the heading settles along the line.
        return stable_yaw(along_rad[::-1], spacing_m, -x_icr_m, closed)[::-1]
    left = math.exp(-spacing_m / x_icr_m)
    turn = math.remainder(along_rad[0] - along_rad[-1], 2.0 * math.pi) + along_rad[-1] - along_rad[0] if closed else 0.0
    directions = along_rad.tolist()
    yaw = [directions[-1]] * (len(directions) + 1)
    for _ in range(_LAPS if closed else 1):
        for at in range(len(directions) - 1, -1, -1):
            # The exact solution over a straight piece.
            half = 0.5 * (yaw[at + 1] - directions[at])
            yaw[at] = directions[at] + 2.0 * math.atan2(left * math.sin(half), math.cos(half))
        yaw[-1] = yaw[0] + turn if closed else yaw[-1]
    return np.array(yaw)
