"""The robot of the circle experiment: the paper's kinematics with a wheel lag and noise, in small explicit steps.

Written out here on purpose, apart from the model that the controller uses.
"""

from __future__ import annotations

import math

import numpy as np

SUBSTEP_S = 0.02


class KinematicPlant:
    """A skid-steer robot that starts at rest.

    `wheel_noise`: standard deviation of each wheel's speed relative to itself, white at 50 Hz.
    """

    def __init__(
        self, theta: dict[str, float], start: tuple[float, float, float], lag_s: float, wheel_noise: float, seed: int
    ) -> None:
        self._radius, self._axial = theta["wheel_radius_m"], theta["axial_distance_m"]
        self._x_icr, self._lag_s, self._wheel_noise = theta["x_icr_m"], lag_s, wheel_noise
        self._rng = np.random.default_rng([seed, 7])
        self.x_m, self.y_m, self.yaw_rad = start
        self.wheels = (0.0, 0.0)
        self.forward_m_s = 0.0

    def advance(self, left_rad_s: float, right_rad_s: float, seconds: float) -> None:
        """Hold these wheel commands for a while."""
        count = max(1, round(seconds / SUBSTEP_S))
        dt = seconds / count
        part = 1.0 - math.exp(-dt / self._lag_s) if self._lag_s > 0.0 else 1.0
        left, right = self.wheels
        for _ in range(count):
            left += (left_rad_s - left) * part
            right += (right_rad_s - right) * part
            noise_left, noise_right = (1.0 + self._wheel_noise * self._rng.standard_normal(2)).tolist()
            rim_left, rim_right = self._radius * left * noise_left, self._radius * right * noise_right
            v, omega = 0.5 * (rim_left + rim_right), (rim_right - rim_left) / self._axial
            middle = self.yaw_rad + 0.5 * omega * dt
            self.x_m += dt * (v * math.cos(middle) + omega * self._x_icr * math.sin(middle))
            self.y_m += dt * (v * math.sin(middle) - omega * self._x_icr * math.cos(middle))
            self.yaw_rad += omega * dt
            self.forward_m_s = v
        self.wheels = (left, right)
