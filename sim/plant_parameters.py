"""Parameters of a plant: geometry, motors, sensors, battery, disturbances; and plants sampled from a posterior."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

# Chosen, for x_icr, wheel radius and axial distance (m): wider than any robot this project drives; beyond, the Gaussian
# is not of a robot.
SMALLEST_SAMPLE = (-1.0, 0.01, 0.05)
LARGEST_SAMPLE = (1.0, 1.0, 2.0)
# Chosen: a Gaussian with less than about one draw in so many inside lies outside.
MAX_DRAWS = 10_000


class DrawError(ValueError):
    """A posterior from which no physical plant can be drawn; the message is one line."""


@dataclass(frozen=True, slots=True)
class PlantParameters:
    """Parameters of the true robot; geometry defaults are the posterior mean of the paper's appendix.

    Geometry: the tracked point is the origin of the body frame, x forward, y left; it lies `x_icr_m` behind the line
    on which the instantaneous centre of rotation moves. Standard deviations are of stationary processes; a probability
    is per pose sample. `speed_loop_time_constant_s` = 0 means wheels that follow their command at once.
    """

    wheel_radius_m: float = 0.061
    axial_distance_m: float = 0.415
    x_icr_m: float = 0.238
    integration_step_us: int = 1000

    # Motors: a speed profile (first-order, limited acceleration) followed by a PI loop with limited torque.
    speed_loop_time_constant_s: float = 0.06
    max_motor_acceleration_rad_s2: float = 60.0
    wheel_inertia_kg_m2: float = 0.03
    viscous_friction_nm_s: float = 0.02
    dry_friction_nm: float = 0.15
    turning_load_nm: float = 0.25
    max_motor_torque_nm: float = 5.0
    tracking_gain_nm_s: float = 1.5
    tracking_integral_gain_nm: float = 30.0
    brake_time_constant_s: float = 0.04
    standstill_hold_rad_s: float = 0.02
    motor_torque_constant_nm_per_a: float = 0.25

    # Encoders and the wheel speed that a controller makes of them.
    ticks_per_rev: int = 2048
    encoder_start_left_ticks: int = 0
    encoder_start_right_ticks: int = 0
    speed_observer_bandwidth_rad_s: float = 100.0

    # Disturbances: of wheel speed relative to itself (fast and slow), of the body's velocity while it moves.
    wheel_disturbance_std: float = 0.015
    wheel_disturbance_correlation_s: float = 0.15
    wheel_drift_std: float = 0.0
    wheel_drift_correlation_s: float = 20.0
    slip_std_x_m_s: float = 0.005
    slip_std_y_m_s: float = 0.004
    slip_std_yaw_rad_s: float = 0.018
    slip_correlation_s: float = 0.3
    volatility: float = 0.0
    volatility_correlation_s: float = 1.0

    # Pose sensor.
    pose_rate_hz: float = 25.0
    pose_position_std_m: float = 0.005
    pose_yaw_std_rad: float = 0.0087
    pose_noise_correlation_s: float = 0.0
    pose_noise_volatility: float = 0.0
    pose_sample_jitter_s: float = 0.0
    pose_delay_s: float = 0.03
    pose_delay_jitter_s: float = 0.002
    pose_dropout_probability: float = 0.0
    pose_gap_interval_s: float = 0.0
    pose_gap_length_s: float = 1.2
    pose_outlier_probability: float = 0.0
    pose_outlier_m: float = 0.2
    pose_outlier_yaw_rad: float = 0.1

    # Battery and heat.
    battery_voltage_v: float = 25.2
    battery_resistance_ohm: float = 0.08
    battery_capacity_ah: float = 5.0
    idle_current_a: float = 0.5
    motor_resistance_ohm: float = 0.3
    motor_thermal_resistance_k_per_w: float = 3.0
    motor_thermal_capacity_j_per_k: float = 60.0
    ambient_temperature_c: float = 22.0

    def noiseless(self) -> PlantParameters:
        """Return the parameters without disturbances, sensor noise, jitter and losses (ticks stay whole)."""
        return replace(
            self,
            wheel_disturbance_std=0.0,
            wheel_drift_std=0.0,
            slip_std_x_m_s=0.0,
            slip_std_y_m_s=0.0,
            slip_std_yaw_rad_s=0.0,
            pose_position_std_m=0.0,
            pose_yaw_std_rad=0.0,
            pose_sample_jitter_s=0.0,
            pose_delay_jitter_s=0.0,
            pose_dropout_probability=0.0,
            pose_gap_interval_s=0.0,
            pose_outlier_probability=0.0,
        )

    def with_ideal_motors(self) -> PlantParameters:
        """Return the parameters with wheels that turn as commanded: only a hidden effect lags or limits them."""
        return replace(
            self,
            speed_loop_time_constant_s=0.0,
            max_motor_acceleration_rad_s2=math.inf,
            max_motor_torque_nm=math.inf,
            turning_load_nm=0.0,
            standstill_hold_rad_s=0.0,
        )


def draw_plant_parameters(
    mean: npt.ArrayLike,
    covariance: npt.ArrayLike,
    seed: int,
    base: PlantParameters | None = None,
) -> PlantParameters:
    """Draw a robot from a Gaussian over (x_icr, wheel radius, axial distance), in metres and this order.

    mean: shape (3,); covariance: shape (3, 3), positive semi-definite, as a model's is. Draws outside
    `SMALLEST_SAMPLE`..`LARGEST_SAMPLE` are drawn again, so the distribution is the truncated Gaussian; everything else
    is taken from `base`. Raises DrawError if `MAX_DRAWS` draws give nothing physical.
    """
    variances, axes = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    root = axes * np.sqrt(np.maximum(variances, 0.0))
    generator = np.random.default_rng(seed)
    for _ in range(MAX_DRAWS):
        sample = np.asarray(mean) + root @ generator.standard_normal(len(SMALLEST_SAMPLE))
        if np.all(sample >= SMALLEST_SAMPLE) and np.all(sample <= LARGEST_SAMPLE):
            x_icr_m, wheel_radius_m, axial_distance_m = (float(number) for number in sample)
            return replace(
                base or PlantParameters(),
                x_icr_m=x_icr_m,
                wheel_radius_m=wheel_radius_m,
                axial_distance_m=axial_distance_m,
            )
    raise DrawError(f"{MAX_DRAWS} draws gave no physical robot; the Gaussian lies outside the physical range")
