"""How the planner works: every knob of DISCO in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from disco_hw import config

ROTATION = 2.0 * math.pi

Uncertainty = Literal["ut", "mc", "point"]


@dataclass(frozen=True, slots=True)
class WheelLimits:
    """What a wheel may be asked for: speed (rad/s) and acceleration (rad/s^2)."""

    speed_rad_s: float
    acceleration_rad_s2: float = math.inf

    @classmethod
    def of_robot(cls, robot: config.Robot) -> WheelLimits:
        """The limits of robot.toml."""
        return cls(robot.max_wheel_speed_rad_s, robot.max_wheel_acceleration_rad_s2)


@dataclass(frozen=True, slots=True)
class DiscoSettings:
    """Settings of DISCO; the defaults are what the robot runs.

    samples: command sequences tried in a step (K). horizon: steps of `step_s` each plan covers (T).
    noise_std_rad_s: standard deviation of the noise on one knot.
    knots: cubic spline knots over the horizon, or None for white noise, one deviate a step.
    uncertainty: `ut` sigma points of the belief, `mc` `draws` of it, `point` the model's point values.
    ut_alpha: spread of the sigma points; 1 keeps all weights non-negative.
    temperature: of the softmax, or None to hold the effective sample size at `target_ess`.
    control_cost_weight: of the paper's term u' Sigma^-1 eps.
    """

    samples: int = 400
    horizon: int = 50
    step_s: float = 0.1
    noise_std_rad_s: float = 0.25 * ROTATION
    knots: int | None = 8
    uncertainty: Uncertainty = "ut"
    draws: int = 7
    ut_alpha: float = 1.0
    temperature: float | None = None
    target_ess: float = 20.0
    control_cost_weight: float = 0.0
    latency_s: float = 0.0

    @classmethod
    def from_config(cls, control: config.Control) -> DiscoSettings:
        """The settings that robot.toml asks for."""
        return cls(
            samples=control.samples, horizon=control.horizon, step_s=control.step_s, uncertainty=control.uncertainty
        )
