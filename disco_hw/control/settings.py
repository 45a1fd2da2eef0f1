"""How the planner works: every knob of DISCO in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from disco_hw import config

ROTATION = 2.0 * math.pi
USUAL_SPEED_M_S, USUAL_STEP_S, USUAL_NOISE = 0.2, 0.1, 0.1 * ROTATION
LONGEST_STEP_S = 0.25
# Noise of a fast robot grows with this power of its speed: with less it stays beside tight circles, with more it is
# pulled off them.
FASTER_NOISE = 0.2
USUAL_WIDE = 3.0

Uncertainty = Literal["ut", "mc", "joint", "point"]
Risk = Literal["mean", "cvar", "worst"]


def _require(holds: bool, field: str, remedy: str) -> None:
    if not holds:
        raise ValueError(f"{field}: must be {remedy}")


@dataclass(frozen=True, slots=True)
class CommandLimits:
    """What a wheel may be asked for: speed (rad/s) and acceleration (rad/s^2)."""

    speed_rad_s: float
    acceleration_rad_s2: float = math.inf

    @classmethod
    def of_robot(cls, robot: config.Robot) -> CommandLimits:
        """The limits of robot.toml."""
        return cls(robot.max_wheel_speed_rad_s, robot.max_wheel_acceleration_rad_s2)


@dataclass(frozen=True, slots=True)
class Sampler:
    """How command sequences are sampled, weighed and carried on; units of a command are the system's.

    samples: sequences tried in a step (K). horizon: steps a plan covers (T).
    noise_std: standard deviation of the noise on one knot; of a fifth of the samples it is `wide` times as large, to
    find what lies further from the plan, as a turn on the spot does (compiled planners only).
    knots: cubic spline knots over the horizon, or None for white noise, one deviate a step.
    with_nominal: whether the plan itself is among the samples.
    temperature: of the softmax, or None to hold the effective sample size at `target_ess`.
    control_cost_weight: of the paper's term u' Sigma^-1 eps.
    update_from: the noise as `applied`, within the limits, or as `drawn`.
    beyond_end: what a shifted plan ends in: `hold` its last command or `zero`.
    risk: what is made of the costs under the parameter points: their `mean`, the mean of the worst `worst_part` of
    their weight (`cvar`), or the `worst`.
    """

    samples: int = 400
    horizon: int = 40
    noise_std: float = USUAL_NOISE
    wide: float = 1.0
    knots: int | None = 7
    with_nominal: bool = True
    temperature: float | None = None
    target_ess: float = 20.0
    control_cost_weight: float = 0.0
    update_from: Literal["applied", "drawn"] = "applied"
    beyond_end: Literal["hold", "zero"] = "hold"
    risk: Risk = "mean"
    worst_part: float = 0.25

    def __post_init__(self) -> None:
        _require(self.samples >= 2, "samples", "at least 2")
        _require(self.horizon >= 2, "horizon", "at least 2")
        _require(self.noise_std > 0.0, "noise_std", "above 0")
        _require(self.wide >= 1.0, "wide", "at least 1")
        _require(self.knots is None or self.knots >= 4, "knots", "at least 4, or None")
        _require(self.temperature is None or self.temperature > 0.0, "temperature", "above 0, or None")
        _require(self.target_ess >= 1.0, "target_ess", "at least 1")
        _require(self.control_cost_weight >= 0.0, "control_cost_weight", "0 or more")
        _require(0.0 < self.worst_part <= 1.0, "worst_part", "in (0, 1]")


@dataclass(frozen=True, slots=True)
class DiscoSettings:
    """Settings of DISCO; the defaults are what the robot runs.

    sampler: how sequences are sampled; its commands are wheel speeds in rad/s. step_s: length of a step.
    uncertainty: what every sequence is rolled out under: `ut` sigma points of the belief; `mc` `draws` of it, fresh
    ones in every step; `joint` one draw a sequence, so that weights are over pairs of sequence and parameters (the
    paper's control law); `point` the model's point values.
    common_draws: whether the draws of `mc` are shared by all sequences of a step (less noise in their order) or every
    sequence has its own, as in the paper's Algorithm 1.
    ut_alpha: spread of the sigma points; 1 keeps all weights non-negative.
    latency_s: from the state to when a command made from it acts, beyond the model's command delay.
    gain_by_time: whether a plan moves only the part shift / step_s towards the new optimum when it is made anew within
    a step. Then the plan changes as fast at any rate, and more plans a second average out noise instead of adding it.
    guide_below: where a steering law's commands cost less than this part of the plan, they take its place (tasks with
    a line; kernel/guide.py); for a horizon also where the plan stands, whatever they cost; 0 without a guide.
    offset_free: whether rollouts move beside the model as the robot was found to (model/coefficients.py), and lose of a
    command what its wheels were found to lose (wheel_loss.py).
    iterations_at_start: optimisation steps for the first plan after a reset.
    min_ess: effective sample size below which a step counts as collapsed: it is tried again, and reported.
    retries: further attempts after a step without a valid result; then the plan is dropped and planned anew.
    decay_s: how long the planner answers with a ramp to zero when nothing helps, before it raises NoValidControl.
    """

    sampler: Sampler = Sampler(wide=USUAL_WIDE)
    step_s: float = USUAL_STEP_S
    uncertainty: Uncertainty = "ut"
    draws: int = 7
    common_draws: bool = True
    ut_alpha: float = 1.0
    latency_s: float = 0.0
    gain_by_time: bool = True
    guide_below: float = 0.85
    offset_free: bool = False
    iterations_at_start: int = 5
    min_ess: float = 3.0
    retries: int = 2
    decay_s: float = 0.5

    def __post_init__(self) -> None:
        _require(self.step_s > 0.0, "step_s", "above 0")
        _require(self.draws >= 1, "draws", "at least 1")
        _require(self.ut_alpha > 0.0, "ut_alpha", "above 0")
        _require(self.latency_s >= 0.0, "latency_s", "0 or more")
        _require(self.iterations_at_start >= 1, "iterations_at_start", "at least 1")
        if self.uncertainty == "ut" and self.ut_alpha < 1.0 and self.sampler.risk != "mean":
            raise ValueError("ut_alpha: below 1 the weight of the mean is negative, so only risk 'mean' has a meaning")

    @classmethod
    def paper(cls, uncertainty: Uncertainty = "ut") -> DiscoSettings:
        """The paper's skid-steer experiment (appendix): white noise, control cost, UT with alpha = 0.5, Algorithm 1.

        K = 400, T = 50, temperature 0.1, control authority 0.25 (rotations per second)^2. Within a step the robot moves
        along the exact arc, as in every mode; the published code takes an Euler step, straight along the heading that
        the step begins with.
        """
        temperature = 0.1
        sampler = Sampler(
            samples=400,
            horizon=50,
            noise_std=math.sqrt(0.25) * ROTATION,
            knots=None,
            with_nominal=False,
            temperature=temperature,
            control_cost_weight=temperature,
            update_from="drawn",
            beyond_end="zero",
        )
        return cls(
            sampler=sampler,
            uncertainty=uncertainty,
            common_draws=False,
            ut_alpha=0.5,
            gain_by_time=False,
            guide_below=0.0,
            iterations_at_start=1,
            min_ess=0.0,
        )

    @classmethod
    def for_speed(cls, speed_m_s: float, rate_hz: float) -> DiscoSettings:
        """What suits a task of this speed at so many plans a second.

        A slow robot plans over the same way as one at 0.2 m/s, with noise in proportion to its speed; a fast one has
        shorter steps, but no more than one a plan. With these the mean distance from circles of 0.3 to 3 m stays below
        2 mm with the true parameters (tests/control/test_no_offset.py).
        """
        slower = USUAL_SPEED_M_S / speed_m_s
        step_s = USUAL_STEP_S * (math.sqrt(slower) if slower < 1.0 else slower)
        step_s = max(min(step_s, LONGEST_STEP_S), 1.0 / rate_hz)
        noise_std = USUAL_NOISE * (slower**-FASTER_NOISE if slower < 1.0 else 1.0 / slower)
        sampler = Sampler(noise_std=noise_std, wide=USUAL_WIDE)
        return cls(sampler=sampler, step_s=step_s)

    @classmethod
    def from_config(cls, control: config.Control, speed_m_s: float) -> DiscoSettings:
        """The settings that robot.toml asks for, for its task's speed."""
        settings = cls.paper() if control.mode == "paper" else cls.for_speed(speed_m_s, control.rate_hz)
        horizon = settings.sampler.horizon if control.horizon is None else control.horizon
        step_s = settings.step_s if control.step_s is None else control.step_s
        sampler = replace(settings.sampler, samples=control.samples, horizon=horizon)
        return replace(
            settings, sampler=sampler, step_s=step_s, uncertainty=control.uncertainty, offset_free=control.disturbance
        )
