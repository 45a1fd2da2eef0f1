"""Least squares on whitened residuals: bounded Levenberg-Marquardt, and what its normal equations say by block."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.channels import Channel

Array = NDArray[np.float64]
Index = NDArray[np.int64]
_MOST_ITERATIONS = 12
_GOOD_ENOUGH = 0.02


@dataclass(frozen=True, slots=True)
class Column:
    """How one entry of a parameter vector is fitted: difference step, bounds."""

    step: float
    low: float
    high: float


COLUMNS: Mapping[str, Column] = {
    "tau_s": Column(2e-3, 0.0, 2.0),
    "delay_s": Column(2e-3, -0.05, 1.0),
    "deadband_rad_s": Column(5e-3, 0.0, 3.0),
    "stiction_rad_s": Column(4e-2, 0.0, 3.0),
    "speed_limit_rad_s": Column(2e-2, 0.2, 1e3),
    "turn_limit_rad_s": Column(2e-2, 0.1, 1e3),
    "sag_per_s": Column(1e-6, -5e-3, 5e-3),
    "gain_left": Column(1e-4, -0.5, 0.5),
    "gain_right": Column(1e-4, -0.5, 0.5),
    "wheel_radius_m": Column(1e-5, 0.005, 2.0),
    "axial_distance_m": Column(1e-4, 0.02, 5.0),
    "x_icr_m": Column(1e-4, -2.0, 2.0),
    "asymmetry": Column(1e-4, -0.3, 0.3),
    "turn_slip_s": Column(1e-3, -0.5, 0.5),
    "acceleration_slip_s2_m": Column(1e-3, -1.0, 1.0),
    "side_slip_s": Column(1e-3, -1.0, 1.0),
    "lateral_icr_m": Column(1e-4, -1.0, 1.0),
    "drift_x_m_s": Column(1e-4, -0.2, 0.2),
    "drift_y_m_s": Column(1e-4, -0.2, 0.2),
    "change_track": Column(1e-3, -0.5, 0.9),
    "change_radius": Column(1e-3, -0.3, 0.3),
    "latency_s": Column(2e-3, -0.1, 1.0),
    "heading_bias_rad": Column(1e-3, -0.5, 0.5),
}


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted parameter vector.

    `cost` is half the sum of squares; `jacobian` (n, A) over the `active` entries, derivative of the residual.
    """

    vector: Array
    active: tuple[int, ...]
    cost: float
    residual: Array
    jacobian: Array

    def information(self) -> Array:
        """Normal matrix, (A, A)."""
        return np.asarray(self.jacobian.T @ self.jacobian)

    def covariance(self) -> Array:
        """Covariance of the active entries under the noise model, (A, A); pseudo-inverse where nothing is known."""
        return inverse(self.information())


def inverse(matrix: Array) -> Array:
    """Inverse of a normal matrix, scaled first; directions without information get a large variance."""
    if not matrix.size:
        return matrix
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    unit = matrix / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(unit)
    return np.asarray((vectors / np.maximum(values, 1e-10)) @ vectors.T / np.outer(scale, scale))


def jacobian(
    residual: Callable[[Array], Array], vector: Array, active: tuple[int, ...], columns: tuple[str, ...], base: Array
) -> Array:
    """Derivative of the residual by central (inside bounds) differences, (n, A); `base` is the residual at `vector`."""
    out = np.empty((base.size, len(active)))
    for place, index in enumerate(active):
        column = COLUMNS[columns[index]]
        up, down = vector.copy(), vector.copy()
        up[index] = min(vector[index] + column.step, column.high)
        down[index] = max(vector[index] - column.step, column.low)
        high = residual(up) if up[index] != vector[index] else base
        low = residual(down) if down[index] != vector[index] else base
        out[:, place] = (high - low) / (up[index] - down[index])
    return out


def fit(
    channel: Channel,
    start: Array,
    active: tuple[int, ...],
    extra: Array | None = None,
    iterations: int = _MOST_ITERATIONS,
) -> Fit:
    """Fit the `active` entries from `start`; `extra` is an unnamed term that is held."""
    columns = channel.columns
    low = np.array([COLUMNS[columns[index]].low for index in active])
    high = np.array([COLUMNS[columns[index]].high for index in active])

    def residual(vector: Array) -> Array:
        return channel.residual(vector, extra)

    vector = start.copy()
    now = residual(vector)
    cost = 0.5 * float(now @ now)
    slope = jacobian(residual, vector, active, columns, now)
    damping = 1e-3
    chosen = list(active)
    for _ in range(iterations if active else 0):
        normal, gradient = slope.T @ slope, slope.T @ now
        scale = np.maximum(np.diag(normal), 1e-12 * max(float(np.max(np.diag(normal))), 1e-30))
        better = False
        gained = 0.0
        for _ in range(6):
            step = -np.linalg.solve(normal + np.diag(damping * scale + 1e-300), gradient)
            trial = vector.copy()
            trial[chosen] = np.clip(vector[chosen] + step, low, high)
            there = residual(trial)
            cost_there = 0.5 * float(there @ there)
            if cost_there < cost:
                gained, better = cost - cost_there, True
                vector, now, cost = trial, there, cost_there
                damping = max(damping * 0.1, 1e-9)
                break
            damping *= 10.0
        if better or damping < 1.0:
            slope = jacobian(residual, vector, active, columns, now)
        if not better or gained < _GOOD_ENOUGH:
            break
    return Fit(vector, active, cost, now, slope)


def by_block(found: Fit, block: Index, blocks_each: int = 1) -> tuple[Array, Array]:
    """Normal matrices (B, A, A) and gradients (B, A) by block of time, `blocks_each` neighbouring blocks as one."""
    label = np.unique(block // blocks_each, return_inverse=True)[1]
    count, width = int(label.max()) + 1, len(found.active)
    normal, gradient = np.zeros((count, width, width)), np.zeros((count, width))
    order = np.argsort(label, kind="stable")
    edges = np.searchsorted(label[order], np.arange(count + 1))
    for b in range(count):
        rows = order[edges[b] : edges[b + 1]]
        part = found.jacobian[rows]
        normal[b] = part.T @ part
        gradient[b] = part.T @ found.residual[rows]
    return normal, gradient
