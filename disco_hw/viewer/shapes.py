"""Points and colours of what the scene draws; plain numbers, no page."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

ELLIPSE_95 = 5.991464547107979
"""Squared Mahalanobis radius that holds 95 % of a Gaussian over the plane."""


def circle_points(center_x_m: float, center_y_m: float, radius_m: float, count: int = 180) -> Array:
    """Points (count + 1, 2) around a circle, the last on the first."""
    angle = np.linspace(0.0, 2.0 * np.pi, count + 1)
    return np.stack((center_x_m + radius_m * np.cos(angle), center_y_m + radius_m * np.sin(angle)), axis=1)


def ellipse_points(x_m: float, y_m: float, covariance: Array, count: int = 48) -> Array:
    """Points (count + 1, 2) on the 95 % ellipse of a position with this covariance (2, 2) m^2; (0, 2) if it is none."""
    if not np.all(np.isfinite(covariance)):
        return np.empty((0, 2))
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if variances[0] < 0.0:
        return np.empty((0, 2))
    circle = circle_points(0.0, 0.0, math.sqrt(ELLIPSE_95), count)
    return np.asarray((circle * np.sqrt(variances)) @ axes.T + (x_m, y_m))


def segments(points: Array, height_m: float) -> Array:
    """Line segments (N - 1, 2, 3) along points (N, 2) at one height."""
    lifted = np.column_stack((points, np.full(len(points), height_m)))
    return np.stack((lifted[:-1], lifted[1:]), axis=1)


def distance_colours(distance_m: Array, full_m: float) -> Bytes:
    """Colours (N, 3) by distance to the task: purple on it, teal at half of `full_m`, yellow at it and beyond.

    They differ in brightness too, so that everybody can tell them apart.
    """
    part = np.clip(np.abs(distance_m) / full_m, 0.0, 1.0)
    ramps = ((68.0, 33.0, 253.0), (1.0, 145.0, 200.0), (84.0, 140.0, 30.0))
    return np.stack([np.interp(part, (0.0, 0.5, 1.0), ramp) for ramp in ramps], axis=1).astype(np.uint8)


def fan_paths(weights: Sequence[float], x_m: Sequence[float], y_m: Sequence[float]) -> Array:
    """Paths (n, points, 2) of a fan that is recorded one path after the other; (0, 0, 2) if it does not divide."""
    count = len(weights)
    if not count or len(x_m) % count or len(x_m) != len(y_m) or len(x_m) < 2 * count:
        return np.empty((0, 0, 2))
    return np.stack((np.reshape(x_m, (count, -1)), np.reshape(y_m, (count, -1))), axis=-1)


def weight_colours(weights: Sequence[float], colour: tuple[int, int, int], palest: float) -> Bytes:
    """Colours (n, 3) by share of the largest weight: `colour` for that one, mixed with white down to `palest` of it."""
    share = np.asarray(weights, np.float64)
    largest = share.max(initial=0.0)
    part = palest + (1.0 - palest) * (share / largest if largest > 0.0 else np.zeros_like(share))
    return np.asarray(255.0 - part[:, None] * (255.0 - np.array(colour)), np.uint8)


def instant_centre(
    pose: tuple[float, float, float], speed_m_s: float, yaw_rate_rad_s: float, x_icr_m: float, farthest_m: float
) -> tuple[float, float] | None:
    """Where the body turns about, in the world; None when it is not a number or farther away than `farthest_m`.

    In the body's frame it lies at (x_icr, v / omega): there the lateral velocity -omega x_icr of the tracked point and
    the forward one v are both undone.
    """
    if not (math.isfinite(speed_m_s) and abs(yaw_rate_rad_s) * farthest_m > abs(speed_m_s)):
        return None
    x_m, y_m, yaw_rad = pose
    forward, left = x_icr_m, speed_m_s / yaw_rate_rad_s
    return (
        x_m + forward * math.cos(yaw_rad) - left * math.sin(yaw_rad),
        y_m + forward * math.sin(yaw_rad) + left * math.cos(yaw_rad),
    )


def about_z(yaw_rad: float) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of a turn about the vertical."""
    return (math.cos(yaw_rad / 2.0), 0.0, 0.0, math.sin(yaw_rad / 2.0))


def about_y(angle_rad: float) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of a turn about the axle, positive as a wheel turns that drives forward."""
    return (math.cos(angle_rad / 2.0), 0.0, math.sin(angle_rad / 2.0), 0.0)
