"""Drift of the ground under a robot, as on a slope: the one motion beside a model that the planner rolls out."""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

MOVES_RAD_S = 0.5
"""Wheels that turn this fast together are carried by the ground as much as they ever are; slower ones in proportion."""


class Drift(msgspec.Struct, frozen=True, gc=False):
    """How fast the ground carries a robot whose wheels turn, along x and y of the world (m/s)."""

    x_m_s: float = 0.0
    y_m_s: float = 0.0

    @property
    def vector(self) -> NDArray[np.float64]:
        """The two speeds, (2,) for `FreeRun`."""
        return np.array([self.x_m_s, self.y_m_s])

    def part_at(self, left_rad_s: float, right_rad_s: float) -> float:
        """Return how much of it acts where the wheels turn at these speeds, from 0 (standing) to 1."""
        return min((abs(left_rad_s) + abs(right_rad_s)) / MOVES_RAD_S, 1.0)

    def in_body(self, carried_s: float, yaw_rad: float) -> tuple[float, float]:
        """Return the way forward and to the left (m) that it carries a robot with this heading in so long."""
        x, y = self.x_m_s * carried_s, self.y_m_s * carried_s
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        return cosine * x + sine * y, cosine * y - sine * x


NO_DRIFT = Drift()
NO_DRIFT_M_S = NO_DRIFT.vector
NO_DRIFT_M_S.flags.writeable = False
