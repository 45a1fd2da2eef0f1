"""Motion that no parameter of the model explains, as estimation finds it and as the planner rolls it out."""

from __future__ import annotations

import math
from typing import TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Number = TypeVar("Number", float, Array)

MOVES_RAD_S = 0.5
"""Wheels that turn this fast together are carried by the ground as much as they ever are; slower ones in proportion."""


class Disturbance(msgspec.Struct, frozen=True, gc=False):
    """What a robot does beside its model, each part in the form in which it is constant while the robot turns.

    Of the body, in proportion to its way, so that a robot that stands is not disturbed: `forward`, the part by which it
    goes farther; `left`, how far it slides to the left for each metre forward; `curvature_per_m`, how far it turns to
    the left for each metre (rad/m). Of the ground, in the world frame: `drift_x_m_s`, `drift_y_m_s`, as on a slope.
    """

    forward: float = 0.0
    left: float = 0.0
    curvature_per_m: float = 0.0
    drift_x_m_s: float = 0.0
    drift_y_m_s: float = 0.0

    @property
    def is_none(self) -> bool:
        """Whether all of it is zero."""
        return not any(msgspec.structs.astuple(self))

    def turning(self, left: Number, right: Number, axial_distance_m: float) -> tuple[Number, Number]:
        """Wheel speeds or angles that would make an undisturbed robot go on and turn as these make this one."""
        more = 0.25 * self.curvature_per_m * axial_distance_m * (left + right)
        scale = 1.0 + self.forward
        return scale * left - more, scale * right + more

    def asked(self, left: Number, right: Number, axial_distance_m: float) -> tuple[Number, Number]:
        """The inverse of `turning`."""
        scale = 1.0 + self.forward
        more = 0.25 * self.curvature_per_m * axial_distance_m * (left + right) / scale
        return (left + more) / scale, (right - more) / scale

    def moving(self, left_rad_s: float, right_rad_s: float) -> float:
        """How much the ground carries a robot whose wheels turn so fast: 0 to 1."""
        return min((abs(left_rad_s) + abs(right_rad_s)) / MOVES_RAD_S, 1.0)

    @property
    def slides(self) -> Array:
        """What moves the robot aside, for `FreeRun`: `left`, `drift_x_m_s`, `drift_y_m_s`, (3,)."""
        return np.array([self.left, self.drift_x_m_s, self.drift_y_m_s])

    def slide(self, distance_m: float, carried_s: float, yaw_rad: float) -> tuple[float, float]:
        """How far a robot of this heading slides forward and to the left of it over a short way (m)."""
        x, y = self.drift_x_m_s * carried_s, self.drift_y_m_s * carried_s
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        return cosine * x + sine * y, cosine * y - sine * x + self.left * distance_m


NO_DISTURBANCE = Disturbance()
NO_SLIDE = NO_DISTURBANCE.slides
