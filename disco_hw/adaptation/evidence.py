"""What a stretch of driving says of the geometry: information and score of each pose, which add up.

Given yaw, the displacement between two poses is r_w (roll_L + roll_R)/2 along and -gamma (roll_R - roll_L) across the
body, and the change of yaw kappa (roll_R - roll_L) (see `coordinates`); over a longer way both directions shrink by
sin(h)/h with h half the turn. Neighbouring displacements share a pose and its noise; the bidiagonal factor of
`inference.estimates` whitens them in one pass, after which every pose adds J'J to the information and J'y to the score.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_banded

from disco_hw.inference.estimates import Whitening, whitening
from disco_hw.inference.excitation import Excitation
from disco_hw.inference.noise import Noise

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, slots=True)
class Evidence:
    """Of poses at `t_s` (P,): `information` (P, 3, 3) and `score` (P, 3) of beta, `square` (P,) of what was measured.

    Everything is whitened. `rows` (P, 3, 4): of x, y and yaw what was measured, and its coefficients of beta. `values`
    (P,) counts the measured numbers: 3, or 0 at the start of a run; `moving_s` (P,) is the time in motion since the
    pose before.
    """

    t_s: Array
    information: Array
    score: Array
    square: Array
    values: Array
    moving_s: Array
    rows: Array

    def part(self, chosen: NDArray[np.bool_]) -> Evidence:
        """The evidence of some of the poses."""
        return Evidence(
            self.t_s[chosen],
            self.information[chosen],
            self.score[chosen],
            self.square[chosen],
            self.values[chosen],
            self.moving_s[chosen],
            self.rows[chosen],
        )


def evidence(drive: Excitation, noise: Noise) -> Evidence:
    """The evidence of each pose of a drive under this noise."""
    slip_m = float(np.hypot(noise.slip_forward_m_sqrt_s, noise.slip_left_m_sqrt_s)) * np.sqrt(0.5)
    inside = ~drive.starts
    steps = np.where(inside[:, None], np.diff(drive.pose, axis=0, prepend=drive.pose[:1]), 0.0)
    middle = drive.pose[:, 2] - 0.5 * steps[:, 2]
    cosine, sine = np.cos(middle), np.sin(middle)
    # np.sinc(x) is sin(pi x) / (pi x).
    shrink = np.sinc(steps[:, 2] / (2.0 * np.pi))
    along, across = drive.roll_rad[:, 0] * shrink, drive.roll_rad[:, 1] * shrink
    in_x = np.column_stack([steps[:, 0], along * cosine, across * sine])
    in_y = np.column_stack([steps[:, 1], along * sine, -across * cosine])
    turned = np.column_stack([steps[:, 2], drive.roll_rad[:, 1]])
    x, y = np.hsplit(_whitened(np.hstack([in_x, in_y]), whitening(drive, noise.position_m, slip_m)), 2)
    yaw = _whitened(turned, whitening(drive, noise.yaw_rad, noise.slip_yaw_rad_sqrt_s))
    x, y, yaw = (np.where(inside[:, None], part, 0.0) for part in (x, y, yaw))

    information = np.zeros((drive.t_s.size, 3, 3))
    information[:, :2, :2] = x[:, 1:, None] * x[:, None, 1:] + y[:, 1:, None] * y[:, None, 1:]
    information[:, 2, 2] = yaw[:, 1] ** 2
    score = np.column_stack([x[:, 1:] * x[:, :1] + y[:, 1:] * y[:, :1], yaw[:, 1] * yaw[:, 0]])
    square = x[:, 0] ** 2 + y[:, 0] ** 2 + yaw[:, 0] ** 2
    rows = np.zeros((drive.t_s.size, 3, 4))
    rows[:, 0, :3], rows[:, 1, :3], rows[:, 2, 0], rows[:, 2, 3] = x, y, yaw[:, 0], yaw[:, 1]
    return Evidence(drive.t_s, information, score, square, np.where(inside, 3.0, 0.0), drive.moving_s, rows)


def _whitened(columns: Array, factor: Whitening) -> Array:
    band = np.vstack([factor.diagonal, np.append(factor.carry[1:], 0.0)])
    return np.asarray(solve_banded((1, 0), band, columns, check_finite=False))
