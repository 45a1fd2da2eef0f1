"""Coordinates in which what a drive says of the geometry is linear, and the way there and back.

    beta = (r_w, gamma, kappa),  kappa = r_w / a_w,  gamma = x_icr kappa

Increments between two poses are linear in beta: yaw in kappa, displacement in r_w (along) and gamma (across).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMES = ("x_icr_m", "wheel_radius_m", "axial_distance_m")
"""The order of theta, as everywhere in inference."""


def to_linear(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of beta from those of theta in the order of `NAMES`, to first order."""
    x_icr, radius, axial = mean.tolist()
    kappa = radius / axial
    by_theta = np.array(
        [
            [0.0, 1.0, 0.0],
            [kappa, x_icr / axial, -x_icr * kappa / axial],
            [0.0, 1.0 / axial, -kappa / axial],
        ]
    )
    return np.array([radius, x_icr * kappa, kappa]), by_theta @ covariance @ by_theta.T


def from_linear(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of theta from those of beta, to first order."""
    radius, gamma, kappa = mean.tolist()
    by_beta = np.array(
        [
            [0.0, 1.0 / kappa, -gamma / kappa**2],
            [1.0, 0.0, 0.0],
            [1.0 / kappa, 0.0, -radius / kappa**2],
        ]
    )
    spread = by_beta @ covariance @ by_beta.T
    return np.array([gamma / kappa, radius, radius / kappa]), 0.5 * (spread + spread.T)
