"""The least distance to a line that any controller can keep on the virtual robot: `python -m tools.tracking_limit`.

The tracked point lies x_icr behind the centre of rotation, and the robot drives forwards: to turn towards the line
first moves the point away from it. Slip therefore leaves a distance that no controller removes. With slip as white
noise of spectral density q (m^2/s) at the centre of rotation, and everything known, its RMS is sqrt(2 q x_icr / v).
Here slip is as in the simulator, correlated in time, and the state is either known or estimated from noisy poses by
the optimal filter. Linear, on the circle of the demonstration; wheels that turn at once as commanded cost nothing.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import solve_continuous_are, solve_continuous_lyapunov

from sim.plant_parameters import PlantParameters

RADIUS_M, SPEED_M_S = 0.75, 0.2
# Small enough that more of the turning would gain less than 0.1 mm.
TURN_COST = 1e-5


def least_rms_m(
    plant: PlantParameters, radius_m: float = RADIUS_M, speed_m_s: float = SPEED_M_S
) -> tuple[float, float]:
    """Return the least RMS distance to a circle: with the state known, and with it estimated from the poses (m).

    States: how far the centre of rotation is outside its circle (m), the heading's error inwards (rad), slip outwards
    of the tracked point (m/s), yaw rate by slip inwards (rad/s). Input: yaw rate of the wheels (rad/s).
    """
    x_icr_m, slip_s = plant.x_icr_m, plant.slip_correlation_s
    turned = math.sqrt(1.0 - (x_icr_m / radius_m) ** 2)
    dynamics = np.zeros((4, 4))
    dynamics[0, 1:] = -speed_m_s, 1.0, -x_icr_m
    dynamics[1, 3] = 1.0
    dynamics[2, 2] = dynamics[3, 3] = -1.0 / slip_s
    turning = np.array([[0.0], [1.0], [0.0], [0.0]])
    slip = np.diag([0.0, 0.0, plant.slip_std_y_m_s**2, plant.slip_std_yaw_rad_s**2]) * 2.0 / slip_s
    distance = turned * np.array([[1.0, x_icr_m, 0.0, 0.0]])
    measured = np.vstack([distance, [0.0, 1.0, 0.0, 0.0]])
    noise = np.diag([plant.pose_position_std_m**2, plant.pose_yaw_std_rad**2]) / plant.pose_rate_hz

    riccati = solve_continuous_are(dynamics, turning, distance.T @ distance, np.array([[TURN_COST]]))
    control = turning.T @ riccati / TURN_COST
    known = solve_continuous_lyapunov(dynamics - turning @ control, -slip)
    error = solve_continuous_are(dynamics.T, measured.T, slip, noise)
    innovation = error @ measured.T @ np.linalg.inv(noise) @ measured @ error
    # The estimate is driven by the innovations, and its error is independent of it.
    estimate = solve_continuous_lyapunov(dynamics - turning @ control, -innovation)
    return _rms(distance, known), _rms(distance, estimate + error)


def _rms(row: np.ndarray, covariance: np.ndarray) -> float:
    return math.sqrt(float((row @ covariance @ row.T).item()))


def main() -> None:
    """Print the limits of the shipped virtual robot."""
    known_m, estimated_m = least_rms_m(PlantParameters())
    print(f"state and slip known {1e3 * known_m:.1f} mm, estimated from its poses {1e3 * estimated_m:.1f} mm")


if __name__ == "__main__":
    main()
