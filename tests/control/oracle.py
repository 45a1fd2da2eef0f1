"""Sampling, cost and update of DISCO in numpy and double precision, written for reading: the oracle of the kernel.

Shapes: K samples, T steps, L parameter points. Algorithm 1 of the paper in its better form; start reading here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control import pendulum
from disco_hw.model import plain as model

Array = NDArray[np.float64]
SequenceCost = Callable[[Array, Array, Array, Array], Array]


def limited(nominal: Array, noise: Array, before: Array, speed: float, change: float) -> Array:
    """Command sequences (K, T, 2): nominal (T, 2) plus noise (K, T, 2), within bounds, one step after the other.

    A wheel's command changes by at most `change` from one step to the next, starting from `before` (2,).
    """
    commands = np.empty_like(noise)
    previous = np.broadcast_to(before, noise[:, 0].shape)
    for t in range(nominal.shape[0]):
        wanted = nominal[t] + noise[:, t]
        previous = np.clip(np.clip(wanted, previous - change, previous + change), -speed, speed)
        commands[:, t] = previous
    return commands


def pendulum_costs(length_m: float, mass_kg: float, angle_rad: float, speed_rad_s: float, torques: Array) -> Array:
    """Costs (K,) of torque sequences (K, T) on the paper's pendulum under one parameter point."""
    angle, speed = np.full(len(torques), angle_rad), np.full(len(torques), speed_rad_s)
    total = np.zeros(len(torques))
    for torque in torques.T:
        angle, speed = pendulum.step(angle, speed, torque, length_m, mass_kg)
        total += pendulum.UPRIGHT_WEIGHT * (np.cos(angle) - 1.0) ** 2 + speed**2
    return total


def point_costs(
    theta: model.Theta, start: model.RobotState, commands: Array, past: Array, step_s: float, cost: SequenceCost,
    time_s: float = 0.0, euler: bool = False,
) -> Array:  # fmt: skip
    """Costs (K,) of command sequences (K, T, 2) under one parameter point; `past` (H, 2) are the commands before."""
    count, horizon = commands.shape[:2]
    all_commands = np.concatenate([np.broadcast_to(past[:, None], (past.shape[0], count, 2)), commands.swapaxes(0, 1)])
    in_force = model.delayed(all_commands, past.shape[0], theta, step_s)
    states, speeds = [start], []
    for t in range(horizon):
        now_s = time_s + t * step_s
        state, forward, _ = model.step(theta, states[-1], in_force[t, :, 0], in_force[t, :, 1], step_s, now_s, euler)
        states.append(state)
        speeds.append(forward)
    x, y, yaw = (np.stack([np.broadcast_to(getattr(s, name), (count,)) for s in states]) for name in ("x", "y", "yaw"))
    return cost(x, y, yaw, np.stack(speeds))


def control_cost(nominal: Array, noise: Array, noise_std: float, weight: float) -> Array:
    """The paper's term, weight * sum_t u_t' Sigma^-1 eps_t, for each sample (K,)."""
    return np.asarray(weight * np.einsum("tc,ktc->k", nominal, noise) / noise_std**2)


def mean_risk(costs: Array, weights: Array) -> Array:
    """Mean over parameter points: costs (L, K), weights (L,), result (K,)."""
    return np.asarray(weights @ costs)


def cvar_risk(costs: Array, weights: Array, worst_part: float) -> Array:
    """Mean over the worst part of the parameter points' weight: costs (L, K), weights (L,) >= 0, result (K,)."""
    result = np.empty(costs.shape[1])
    for k, column in enumerate(costs.T):
        order = np.argsort(-column)
        before = np.concatenate([[0.0], np.cumsum(weights[order])[:-1]])
        taken = np.clip(worst_part - before, 0.0, weights[order])
        result[k] = taken @ column[order] / taken.sum()
    return result


def softmax_weights(costs: Array, temperature: float) -> Array:
    """Weights (K,) of the samples, summing to one; a cost that is not finite gets none."""
    finite = np.isfinite(costs)
    raw = np.exp(-(np.where(finite, costs, np.inf) - costs[finite].min()) / temperature)
    return np.asarray(raw / raw.sum())


def effective_sample_size(weights: Array) -> float:
    """1 / sum of squares of weights that sum to one."""
    return float(1.0 / np.sum(weights**2))


def temperature_for(costs: Array, target_ess: float) -> float:
    """Temperature at which the effective sample size is the target, by bisection of its logarithm."""
    low, high = np.log(1e-6), np.log(1e6)
    for _ in range(100):
        middle = 0.5 * (low + high)
        if effective_sample_size(softmax_weights(costs, np.exp(middle))) > target_ess:
            high = middle
        else:
            low = middle
    return float(np.exp(0.5 * (low + high)))


def updated(commands: Array, weights: Array) -> Array:
    """The next sequence (T, 2): the weighted mean of what was applied; u + sum w eps for eps as applied."""
    return np.asarray(np.einsum("k,ktc->tc", weights, commands))
