"""Whether a heading that comes with a standard deviation or variance was measured at all."""

from __future__ import annotations

import math

UNKNOWN_VARIANCE_RAD2 = 1e3
"""Senders write a variance this large, or -1, for a coordinate that they do not measure (robot_localization)."""


def is_heading_filled_in(yaw: float, spread: float) -> bool:
    """Return whether somebody has filled in a heading and its spread (standard deviation or variance, any unit).

    Nobody has where one is not a number, where the spread is negative, and where both are exactly zero, as in a message
    that holds a position only.
    """
    return math.isfinite(yaw) and spread >= 0.0 and (yaw != 0.0 or spread != 0.0)


def is_variance_known(variance_rad2: float) -> bool:
    """Return whether the variance of a heading says anything: not negative, a number, and below 1000 rad^2."""
    return 0.0 <= variance_rad2 < UNKNOWN_VARIANCE_RAD2


def is_heading_measured(yaw_rad: float, variance_rad2: float) -> bool:
    """Return whether a heading with this variance is a measurement: filled in, with a variance that is known."""
    return is_heading_filled_in(yaw_rad, variance_rad2) and is_variance_known(variance_rad2)
