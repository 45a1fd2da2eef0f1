"""A pose sensor as motion capture or scan matching is one: sampled, noisy, late, and sometimes wrong or silent."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from sim.body_dynamics import Pose
from sim.effects import HiddenEffects
from sim.plant_parameters import PlantParameters

LARGEST_JITTER_PERIODS = 0.45


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


def wrapped(angle_rad: float) -> float:
    """The same angle in (-pi, pi]."""
    turn = math.remainder(angle_rad, 2.0 * math.pi)
    return math.pi if turn == -math.pi else turn


class PoseSensor:
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

    def sample(self, pose: Pose) -> PoseMeasurement | None:
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
