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

    def shifted(self, states: Array, x_icr_m: float, step_s: float) -> Array:
        """States (N + 1, 5) of an undisturbed robot, with the way that this one slides beside them."""
        found = states.copy()
        axle = states[:, :2] + x_icr_m * np.column_stack([np.cos(states[:, 2]), np.sin(states[:, 2])])
        middle = 0.5 * (states[1:, 3:] + states[:-1, 3:])
        carried_s = np.minimum(np.abs(middle).sum(1) / MOVES_RAD_S, 1.0) * step_s
        time_s = np.concatenate([[0.0], np.cumsum(carried_s)])
        found[:, 0] += time_s * self.drift_x_m_s - self.left * (axle[:, 1] - axle[0, 1])
        found[:, 1] += time_s * self.drift_y_m_s + self.left * (axle[:, 0] - axle[0, 0])
        return found

    def slide(self, distance_m: float, carried_s: float, yaw_rad: float) -> tuple[float, float]:
        """How far a robot of this heading slides forward and to the left of it over a short way (m)."""
        x, y = self.drift_x_m_s * carried_s, self.drift_y_m_s * carried_s
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        return cosine * x + sine * y, cosine * y - sine * x + self.left * distance_m


NO_DISTURBANCE = Disturbance()
