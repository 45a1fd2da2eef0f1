"""Sensors of the robot: wheel encoders, a pose sensor, and readings of current, voltage and temperature.

The pose sensor is one as motion capture or scan matching: sampled, noisy, late, and sometimes wrong or silent.
"""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from drivers.kernel_cache import compiled
from sim.body_dynamics import BodyPose
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters
from sim.wheel_dynamics import WheelPieces

# Below half a period, so that samples keep their order.
LARGEST_JITTER_PERIODS = 0.45
_ENCODER = np.dtype(
    [("scale", "f8"), ("start", "i8"), ("ticks", "i8"), ("observed_ticks", "f8"), ("speed", "f8")], align=True
)
# Chosen: share of the voltage that an empty battery has lost, about a lithium cell's.
VOLTAGE_LOST_WHEN_EMPTY = 0.2
SECONDS_PER_HOUR = 3600.0
# Chosen: K for each A^2, a few at usual currents.
BATTERY_HEATING = 0.02


class Encoders:
    """Encoders of the left and right wheel.

    Ticks are cumulative and never wrap here; the width of a counter is its reader's affair. The speed comes from a
    second-order tracking observer of the ticks (critically damped, rad/s), held at zero below what one tick can mean.
    """

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects) -> None:
        ticks_per_rad = parameters.ticks_per_rev / (2.0 * math.pi)
        self._ticks_per_rad = ticks_per_rad
        self._bandwidth_rad_s = parameters.speed_observer_bandwidth_rad_s
        self._state = np.zeros(2, dtype=_ENCODER)
        self._state["scale"] = [(1.0 + scale) * ticks_per_rad for scale in effects.values("encoder_scale")]
        start = [parameters.encoder_start_left_ticks, parameters.encoder_start_right_ticks]
        self._state["start"] = start
        self._state["ticks"] = start
        self._state["observed_ticks"] = np.array(start) + 0.5

    @property
    def ticks(self) -> tuple[int, int]:
        """Cumulative ticks, left and right."""
        left, right = self._state["ticks"].tolist()
        return left, right

    @property
    def speeds_rad_s(self) -> tuple[float, float]:
        """Wheel speeds as the controller knows them, left and right."""
        left, right = self._state["speed"].tolist()
        return left, right

    def advance(self, now_us: int, pieces: WheelPieces, count: int) -> None:
        """Read the encoders at the ends of the first `count` pieces, the first of which begins at `now_us`."""
        _advance(self._state, self._ticks_per_rad, self._bandwidth_rad_s, now_us, pieces.times_us, pieces.angles, count)


@compiled
def _advance(
    encoders: Any,
    ticks_per_rad: float,
    bandwidth: float,
    now_us: int,
    times_us: npt.NDArray[np.int64],
    angles: npt.NDArray[np.float64],
    count: int,
) -> None:
    for piece in range(count):
        dt = (times_us[piece] - now_us) * 1e-6
        now_us = times_us[piece]
        smallest = 0.5 * dt * bandwidth * bandwidth / ticks_per_rad
        for side in range(2):
            encoder = encoders[side]
            ticks = encoder["start"] + math.floor(angles[piece, side] * encoder["scale"])
            encoder["ticks"] = ticks
            expected = encoder["observed_ticks"] + dt * encoder["speed"] * ticks_per_rad
            surprise = ticks + 0.5 - expected
            encoder["observed_ticks"] = expected + 2.0 * bandwidth * dt * surprise
            speed = encoder["speed"] + dt * bandwidth * bandwidth * surprise / ticks_per_rad
            if abs(speed) < smallest:
                speed = 0.0
            encoder["speed"] = speed


class PoseMeasurement(msgspec.Struct, frozen=True, gc=False):
    """One measured pose in the world frame (m, rad; yaw in (-pi, pi]) with the sensor's own standard deviations.

    `sample_us` is the plant time at which the sensor says it was true, `available_us` when it can be read.
    """

    sample_us: int
    available_us: int
    x_m: float
    y_m: float
    yaw_rad: float
    position_std_m: float
    yaw_std_rad: float


class SampledPoseSensor:
    """Asks for the true pose at `next_true_us` and turns it into a measurement, or into nothing when it is lost.

    Every sample takes the same number of random numbers whatever the options, so that switching one on leaves the
    others' random numbers as they were.
    """

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects, seed: np.random.SeedSequence) -> None:
        self._parameters = parameters
        self._generator = np.random.default_rng(seed)
        self._latency_us = round(effects.values("pose_latency")[0] * 1e6)
        self._forward_m, self._left_m = effects.values("pose_offset")
        (self._bias_rad,) = effects.values("heading_bias")
        self._period_us = 1e6 / parameters.pose_rate_hz
        correlation_s = parameters.pose_noise_correlation_s
        self._decay = math.exp(-1.0 / (parameters.pose_rate_hz * correlation_s)) if correlation_s > 0.0 else 0.0
        self._fresh = math.sqrt(1.0 - self._decay**2)
        self._noise: list[float] = self._generator.standard_normal(3).tolist()
        self._silent_until_us = 0
        self._count = 0
        self._schedule()

    def sample(self, pose: BodyPose) -> PoseMeasurement | None:
        """Measure the true pose of `next_true_us`; None if the sample is lost. Moves on to the next sample."""
        p = self._parameters
        normal: list[float] = self._generator.standard_normal(6).tolist()
        chance: list[float] = self._generator.random(5).tolist()
        self._noise = [self._decay * old + self._fresh * new for old, new in zip(self._noise, normal[:3], strict=True)]
        burst = math.exp(p.pose_noise_volatility * normal[3] - p.pose_noise_volatility**2)
        position_noise = p.pose_position_std_m * burst
        sample_us = self._sample_us
        delay_us = round(max(p.pose_delay_s + p.pose_delay_jitter_s * normal[4], 0.0) * 1e6)

        cosine, sine = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        x = pose.x_m + cosine * self._forward_m - sine * self._left_m + position_noise * self._noise[0]
        y = pose.y_m + sine * self._forward_m + cosine * self._left_m + position_noise * self._noise[1]
        yaw = pose.yaw_rad + self._bias_rad + p.pose_yaw_std_rad * burst * self._noise[2]
        if chance[0] < p.pose_outlier_probability:
            distance, direction = p.pose_outlier_m * (0.25 + 0.75 * chance[1]), 2.0 * math.pi * chance[2]
            x += distance * math.cos(direction)
            y += distance * math.sin(direction)
            yaw += p.pose_outlier_yaw_rad * normal[5]

        if p.pose_gap_interval_s > 0.0 and chance[3] < 1.0 / (p.pose_rate_hz * p.pose_gap_interval_s):
            self._silent_until_us = max(self._silent_until_us, sample_us + round(p.pose_gap_length_s * 1e6))
        lost = sample_us < self._silent_until_us or chance[4] < p.pose_dropout_probability
        self._schedule()
        if lost:
            return None
        return PoseMeasurement(
            sample_us=sample_us,
            available_us=sample_us + delay_us,
            x_m=x,
            y_m=y,
            yaw_rad=wrapped(yaw),
            position_std_m=p.pose_position_std_m,
            yaw_std_rad=p.pose_yaw_std_rad,
        )

    def _schedule(self) -> None:
        """Set when the next sample is true (`next_true_us`) and when it says it is."""
        self._count += 1
        jitter_us = self._parameters.pose_sample_jitter_s * 1e6 * float(self._generator.standard_normal())
        most_us = LARGEST_JITTER_PERIODS * self._period_us
        self._sample_us = round(self._count * self._period_us + min(max(jitter_us, -most_us), most_us))
        self.next_true_us = max(self._sample_us - self._latency_us, 0)


def wrapped(angle_rad: float) -> float:
    """Return the same angle in (-pi, pi]."""
    turn = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if turn == -math.pi else turn


class Battery(msgspec.Struct, frozen=True, gc=False):
    """Voltage (V), current drawn (A, positive out of the battery) and temperature (degC)."""

    voltage_v: float
    current_a: float
    temperature_c: float


class Electrics:
    """Battery with inner resistance and falling open-circuit voltage; motors that warm up with the current squared."""

    def __init__(self, parameters: PlantParameters, effects: HiddenEffects) -> None:
        self._parameters = parameters
        sag, duration_s = effects.values("battery_sag")
        self._sag_per_s = sag / duration_s
        self._charge_used_as = 0.0
        self.motor_currents_a = (0.0, 0.0)
        self.motor_temperatures_c = (parameters.ambient_temperature_c, parameters.ambient_temperature_c)
        self.battery = Battery(parameters.battery_voltage_v, 0.0, parameters.ambient_temperature_c)

    def advance(
        self,
        now_s: float,
        dt_s: float,
        torques_nm: tuple[float, float],
        speeds_rad_s: tuple[float, float],
    ) -> None:
        """Move on by `dt_s` to `now_s` with these motor torques and wheel speeds (left, right)."""
        p = self._parameters
        (left_nm, right_nm), (left_rad_s, right_rad_s) = torques_nm, speeds_rad_s
        left_a, right_a = left_nm / p.motor_torque_constant_nm_per_a, right_nm / p.motor_torque_constant_nm_per_a
        left_w, right_w = p.motor_resistance_ohm * left_a**2, p.motor_resistance_ohm * right_a**2
        mechanical_w = left_nm * left_rad_s + right_nm * right_rad_s
        drawn_a = p.idle_current_a + (mechanical_w + (left_w + right_w)) / p.battery_voltage_v
        self._charge_used_as += drawn_a * dt_s
        empty = self._charge_used_as / (p.battery_capacity_ah * SECONDS_PER_HOUR)
        open_v = p.battery_voltage_v * (1.0 - VOLTAGE_LOST_WHEN_EMPTY * empty - self._sag_per_s * now_s)
        self.motor_currents_a = (left_a, right_a)
        cooled = math.exp(-dt_s / (p.motor_thermal_resistance_k_per_w * p.motor_thermal_capacity_j_per_k))
        left_c, right_c = self.motor_temperatures_c
        self.motor_temperatures_c = (self._warmed(left_c, left_w, cooled), self._warmed(right_c, right_w, cooled))
        self.battery = Battery(
            voltage_v=max(open_v - p.battery_resistance_ohm * drawn_a, 0.0),
            current_a=drawn_a,
            temperature_c=p.ambient_temperature_c + BATTERY_HEATING * drawn_a**2,
        )

    def _warmed(self, now_c: float, heat_w: float, cooled: float) -> float:
        """Return a motor's temperature on its way to where this heat keeps it."""
        p = self._parameters
        rise_k = p.motor_thermal_resistance_k_per_w * heat_w
        return p.ambient_temperature_c + rise_k + (now_c - p.ambient_temperature_c - rise_k) * cooled
