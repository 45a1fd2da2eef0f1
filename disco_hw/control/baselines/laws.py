"""Steering laws of path following: pure pursuit, Kanayama's, and a linear-quadratic regulator.

All act on the centre of rotation, which moves as a unicycle, beside the reference motion of `Reference`; the integral
is of the tracked point's distance from the line. Gains are what
`python -m tools.tune_baselines` found; those of the regulator are chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_continuous_are

from disco_hw.control.baselines.follower import Errors, Reference


@dataclass(frozen=True, slots=True)
class PurePursuit:
    """Turn towards the reference `look_ahead_m` further on (Coulter 1992), and against the integral if any."""

    look_ahead_m: float = 0.14
    integral: float = 0.0
    preview_s: float = 0.11
    largest_sum_m_s: float = 0.3

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """The arc through the goal, less the reference's."""
        goal_x, goal_y = reference.axle_m(reference.ahead(errors.place, self.look_ahead_m))
        axle_x, axle_y = x_m + reference.x_icr_m * math.cos(yaw_rad), y_m + reference.x_icr_m * math.sin(yaw_rad)
        to_x, to_y = goal_x - axle_x, goal_y - axle_y
        left = to_y * math.cos(yaw_rad) - to_x * math.sin(yaw_rad)
        arc = 2.0 * left / max(to_x * to_x + to_y * to_y, 1e-4)
        wanted = float(reference.forward_m_s[errors.place]) * arc
        wanted -= self.integral * reference.speed_m_s * errors.sum_m_s
        return wanted - float(reference.turn_rad_s[errors.place]), 1.0


@dataclass(frozen=True, slots=True)
class Kanayama:
    """omega = omega_r - v_r (left e + yaw sin e_yaw + integral of e), e to the left (Kanayama et al. 1990)."""

    left: float = 184.0
    yaw: float = 15.7
    integral: float = 0.31
    preview_s: float = 0.12
    largest_sum_m_s: float = 0.3

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """The law; the reference's speed is kept but for the cosine of the heading's error."""
        correction = self.left * errors.left_m + self.yaw * math.sin(errors.yaw_rad) + self.integral * errors.sum_m_s
        return -reference.speed_m_s * correction, max(math.cos(errors.yaw_rad), 0.2)


@dataclass(frozen=True, slots=True)
class LinearQuadratic:
    """State feedback of (integral, distance, yaw) that is optimal for these weights against turning, by length driven.

    e' = yaw, yaw' = correction, sum' = e over the length, from the continuous Riccati equation.
    """

    sum_weight: float = 100.0
    left_weight: float = 200.0
    yaw_weight: float = 20.0
    preview_s: float = 0.1
    largest_sum_m_s: float = 0.3
    gains: tuple[float, float, float] = field(init=False)

    def __post_init__(self) -> None:
        dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        control = np.array([[0.0], [0.0], [1.0]])
        weights = np.diag([self.sum_weight, self.left_weight, self.yaw_weight])
        riccati = solve_continuous_are(dynamics, control, weights, np.eye(1))
        integral, left, yaw = (control.T @ riccati)[0].tolist()
        object.__setattr__(self, "gains", (integral, left, yaw))

    def turn(self, reference: Reference, errors: Errors, x_m: float, y_m: float, yaw_rad: float) -> tuple[float, float]:
        """Gains times state."""
        integral, left, yaw = self.gains
        length = reference.speed_m_s * errors.sum_m_s
        correction = integral * length + left * errors.left_m + yaw * math.sin(errors.yaw_rad)
        return -reference.speed_m_s * correction, max(math.cos(errors.yaw_rad), 0.2)
