"""Sampling, cost and update of DISCO in numpy and double precision, written for reading: the oracle of the kernel.

Shapes: K samples, T steps, L parameter points. Algorithm 1 of the paper in its better form; start reading here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from disco_hw.control import pendulum
from disco_hw.control.tasks.circle import Circle
from disco_hw.control.tasks.path import AGAINST_M, FARTHEST_STEP_M, SLOW_DOWN_S, STANDING_M, TERMINAL_S, Path
from disco_hw.control.tasks.timed_path import RESTS_M, TimedPath
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


def circle_cost(circle: Circle, step_s: float) -> SequenceCost:
    """Cost of paths x, y, yaw (T + 1, K) and forward speeds (T, K) round a circle; see `Circle`."""

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        x, y = x - circle.center_x_m, y - circle.center_y_m
        off_edge = np.hypot(x[1:], y[1:]) - circle.radius_m
        paper = np.hypot(off_edge, forward - circle.speed_m_s).sum(axis=0)
        closest = np.maximum(x[1:] ** 2 + y[1:] ** 2, (circle.radius_m / 2.0) ** 2)
        angle = (x[:-1] * y[1:] - y[:-1] * x[1:]) / closest
        missing = circle.progress_part * circle.speed_m_s * len(forward) - circle.radius_m / step_s * angle.sum(axis=0)
        last = circle.terminal_s / step_s * np.abs(off_edge[-1])
        return np.asarray(paper + circle.progress_weight * np.maximum(missing, 0.0) + last)

    return cost


def facing_cost(yaw: Array, along_x: Array | float, along_y: Array | float) -> Array:
    """Cost of a step for the part of the heading that is against the way."""
    return AGAINST_M * np.maximum(-(np.cos(yaw) * along_x + np.sin(yaw) * along_y), 0.0)


def path_cost(path: Path, place: float, step_s: float) -> SequenceCost:
    """Cost of paths (T + 1, K) along way-points by arc length, from a place (entries of the path's table); see `Path`.

    Every step moves the place by its projection on the path's direction there, within the place's piece.
    """
    table, count = path.table, len(path.table) - 1
    place, first, last = path.piece(place)
    endless = path.closed and not path.sharp_turns
    weight = max(1.0, STANDING_M / path.speed_m_s)

    def off(at: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Offset from the path's point at a place, and the path's direction there."""
        index = np.minimum(at, last - 1.0).astype(int)
        part = (at - index)[:, None]
        here, there = (table[i % count if path.closed else i] for i in (index, index + 1))
        off_x, off_y = (np.column_stack([x, y]) - (1.0 - part) * here[:, :2] - part * there[:, :2]).T
        return off_x, off_y, here[:, 2], here[:, 3]

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        at, total = np.full(x.shape[1], place), np.zeros(x.shape[1])
        for x_now, y_now, yaw_now, forward_now in zip(x[1:], y[1:], yaw[1:], forward, strict=True):
            off_x, off_y, along_x, along_y = off(at, x_now, y_now)
            along = np.clip(off_x * along_x + off_y * along_y, -FARTHEST_STEP_M, FARTHEST_STEP_M)
            wanted = np.full(at.shape, path.speed_m_s)
            if not endless:
                wanted = np.minimum(wanted, (last - at) * path.spacing_m / SLOW_DOWN_S)
            at = at + along / path.spacing_m
            at = np.mod(at, last) if endless else np.clip(at, first, last)
            off_x, off_y, along_x, along_y = off(at, x_now, y_now)
            missing = weight * (wanted - np.minimum(along / step_s, forward_now))
            total += np.hypot(np.hypot(off_x, off_y), missing) + facing_cost(yaw_now, along_x, along_y)
        return np.asarray(total + TERMINAL_S / step_s * np.hypot(off_x, off_y))

    return cost


def timed_path_cost(path: TimedPath, time_s: float, step_s: float) -> SequenceCost:
    """Cost of paths (T + 1, K) along way-points by time, which is `time_s` at the start; see `TimedPath`."""
    due_s = path.waypoints.times_s
    assert due_s is not None, "a path by time has times"

    def cost(x: Array, y: Array, yaw: Array, forward: Array) -> Array:
        times = time_s + step_s * np.arange(len(x))
        there_x, there_y = (np.interp(times, due_s, column)[:, None] for column in path.waypoints.places_m.T)
        length = np.hypot(np.diff(there_x, axis=0), np.diff(there_y, axis=0))
        length = np.where(length < RESTS_M, np.inf, length)
        facing = facing_cost(yaw[1:], np.diff(there_x, axis=0) / length, np.diff(there_y, axis=0) / length)
        return np.asarray((np.hypot(x[1:] - there_x[1:], y[1:] - there_y[1:]) + facing).sum(axis=0))

    return cost


def pendulum_costs(length_m: float, mass_kg: float, angle_rad: float, speed_rad_s: float, torques: Array) -> Array:
    """Costs (K,) of torque sequences (K, T) on the paper's pendulum under one parameter point."""
    angle, speed = np.full(len(torques), angle_rad), np.full(len(torques), speed_rad_s)
    total = np.zeros(len(torques))
    for torque in torques.T:
        angle, speed = pendulum.step(angle, speed, torque, length_m, mass_kg)
        total += pendulum.UPRIGHT_WEIGHT * (np.cos(angle) - 1.0) ** 2 + speed**2
    return total


def point_costs(
    theta: model.Theta, start: model.State, commands: Array, past: Array, step_s: float, cost: SequenceCost,
    time_s: float = 0.0,
) -> Array:  # fmt: skip
    """Costs (K,) of command sequences (K, T, 2) under one parameter point; `past` (H, 2) are the commands before."""
    count, horizon = commands.shape[:2]
    all_commands = np.concatenate([np.broadcast_to(past[:, None], (past.shape[0], count, 2)), commands.swapaxes(0, 1)])
    in_force = model.delayed(all_commands, past.shape[0], theta, step_s)
    states, speeds = [start], []
    for t in range(horizon):
        now_s = time_s + t * step_s
        state, forward, _ = model.step(theta, states[-1], in_force[t, :, 0], in_force[t, :, 1], step_s, now_s)
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
