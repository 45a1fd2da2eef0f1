"""Pendulum of the paper: a rod swung up by a torque at its joint, as a system that DISCO rolls out.

theta is 0 upright; theta'' = 3 g / (2 l) sin(theta) + 3 u / (m l^2), with steps in the order of the Gym environment
that the paper used: the angle moves with the new speed, then the speed is cut. Stage cost of the state after each step:
50 (cos(theta) - 1)^2 + theta'^2. (The paper prints 50 cos(theta - 1)^2, which does not swing up.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.kernel import BLOCK, Floats, U, rolls_out
from disco_hw.control.kernel.sequences import cos_sin_half_turns
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.plan import NoValidControl, Sampler
from disco_hw.jit import block_function, cast_like, scalar_function, tune_loops
from disco_hw.tasks import single

Array = NDArray[np.float64]
# Any: numbers or arrays of any shape, and the same come back.
Values: TypeAlias = Any

# Step and limits of the Gym environment, gravity of the model, and weight of the cost, as said above.
STEP_S = 0.05
LARGEST_TORQUE_NM = 2.0
LARGEST_SPEED_RAD_S = 8.0
GRAVITY_M_S2 = 9.8
UPRIGHT_WEIGHT = 50.0

PAPER_SAMPLER = Sampler(
    samples=500,
    horizon=30,
    noise_std=1.0,
    knots=None,
    with_nominal=False,
    temperature=10.0,
    control_cost_weight=10.0,
    update_from="drawn",
    beyond_end="zero",
)

_ANGLE, _SPEED, _SINE, _TOTAL = (U(row) * BLOCK for row in range(4))


class PendulumTerms(NamedTuple):
    """Terms of the pendulum's kernel: `start` (2,) angle and speed, tables of L points, or of K' for each if `each`.

    `gravity` is 3 g step / (2 l), `gain` 3 step / (m l^2); `each` is None or anything else.
    """

    start: Floats
    gravity: Floats
    gain: Floats
    each: bool | None
    step_s: float


def instant_cost(angle_rad: float, speed_rad_s: float) -> float:
    """Return the stage cost of a state."""
    return UPRIGHT_WEIGHT * (math.cos(angle_rad) - 1.0) ** 2 + speed_rad_s**2


def step(
    angle_rad: Values, speed_rad_s: Values, torque_nm: Values, length_m: Values, mass_kg: Values,
    gravity_m_s2: float = GRAVITY_M_S2,
) -> tuple[Values, Values]:  # fmt: skip
    """Angle and speed after one step, in numpy and for arrays of any shape; the torque is cut here."""
    torque = np.clip(torque_nm, -LARGEST_TORQUE_NM, LARGEST_TORQUE_NM)
    acceleration = 1.5 * gravity_m_s2 / length_m * np.sin(angle_rad) + 3.0 * torque / (mass_kg * length_m**2)
    speed = speed_rad_s + acceleration * STEP_S
    angle = angle_rad + speed * STEP_S
    return angle, np.clip(speed, -LARGEST_SPEED_RAD_S, LARGEST_SPEED_RAD_S)


@dataclass(frozen=True, eq=False, slots=True)
class PendulumPoints:
    """Parameter points of a pendulum: `theta` (L, 2) length (m) and mass (kg), both positive, and weights (L,).

    With `each`, theta holds L points for each of K' samples, (L, K', 2).
    """

    theta: Array
    weights: Array
    each: bool = False


class PendulumPlanner:
    """DISCO for the pendulum, on an `optimiser`: torques from angles and speeds, one step of STEP_S at a time."""

    def __init__(self, points: PendulumPoints, sampler: Sampler = PAPER_SAMPLER, seed: int = 1) -> None:
        self.optimiser = Optimiser(sampler, 1, points.weights.size, 0, LARGEST_TORQUE_NM, math.inf, seed)
        self._begun = False
        self.set_points(points)

    def set_points(self, points: PendulumPoints) -> None:
        """Plan under these parameter points from now on; their number must not change."""
        length, mass = points.theta[..., 0].ravel(), points.theta[..., 1].ravel()
        f32 = np.float32
        self._terms = PendulumTerms(
            np.zeros(2, f32),
            (1.5 * GRAVITY_M_S2 / length * STEP_S).astype(f32),
            (3.0 / (mass * length**2) * STEP_S).astype(f32),
            True if points.each else None,
            single(STEP_S),
        )
        self._weights = points.weights.astype(f32)

    def plan(self, angle_rad: float, speed_rad_s: float) -> Array:
        """Torques (T,) Nm from this state on, one a step; raises NoValidControl if no sample has a finite cost."""
        # A whole turn more or less changes nothing but the precision of the rollouts.
        self._terms.start[:] = (math.remainder(angle_rad, 2.0 * math.pi), speed_rad_s)
        shift_steps, self._begun = (1.0 if self._begun else 0.0), True
        if not self.optimiser.step(shift_steps, 1.0, (0.0,), self._terms, self._weights):
            raise NoValidControl("no torque sequence has a finite cost; check the state and the parameters")
        return self.optimiser.nominal()[:, 0]


@scalar_function
def _value(table: Floats, lane: int, point: int, each: bool | None) -> float:
    """Entry of a table for a sample: the point's, or the sample's own."""
    if each is None:
        return table[point]
    return table[lane]


@scalar_function
def _cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle."""
    return cos_sin_half_turns(angle * cast_like(1.0 / math.pi, angle))


@block_function
def _roll(
    costs: Floats, at: int, point: int, horizon: int, commands: Floats, state: Floats, start: Floats,
    gravity: Floats, gain: Floats, step_s: float, each: bool | None,
) -> None:  # fmt: skip
    """Roll the block's torques out with one parameter point, or each sample's own; writes `costs[at:at + BLOCK]`."""
    tune_loops()
    angle0, speed0 = start[0], start[1]
    one, most, upright = (
        cast_like(1.0, step_s),
        cast_like(LARGEST_SPEED_RAD_S, step_s),
        cast_like(UPRIGHT_WEIGHT, step_s),
    )
    for b in range(BLOCK):
        state[_ANGLE + b] = angle0
        state[_SPEED + b] = speed0
        state[_SINE + b] = math.sin(angle0)
        state[_TOTAL + b] = cast_like(0.0, step_s)
    for t in range(horizon):
        row = U(t) * BLOCK
        for b in range(BLOCK):
            pull = _value(gravity, at + b, point, each) * state[_SINE + b]
            push = _value(gain, at + b, point, each) * commands[row + b]
            speed = state[_SPEED + b] + (pull + push)
            angle = state[_ANGLE + b] + speed * step_s
            speed = min(max(speed, -most), most)
            cosine, sine = _cos_sin(angle)
            off = cosine - one
            state[_ANGLE + b] = angle
            state[_SPEED + b] = speed
            state[_SINE + b] = sine
            state[_TOTAL + b] += (upright * off) * off + speed * speed
    for b in range(BLOCK):
        costs[at + b] = state[_TOTAL + b]


@rolls_out(PendulumTerms)
def roll_pendulum(
    system: PendulumTerms, costs: Floats, points: int, padded: int, block: int, horizon: int, commands: Floats,
    state: Floats,
) -> None:  # fmt: skip
    """Costs of one block of samples under all parameter points; see `roll_block`."""
    for i in range(points):
        at = U(i * padded) + U(block) * BLOCK
        _roll(
            costs, at, i, horizon, commands, state, system.start, system.gravity, system.gain, system.step_s,
            system.each,
        )  # fmt: skip
