"""From noise to command sequences: nominal plus noise, within the limits, one block of samples at a time; and back.

Commands lie as rows of BLOCK samples: row (history + t) * C + c is channel c at step t, for C channels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from disco_hw.control.blocks import BLOCK, U
from disco_hw.model.jit import block_function, scalar_function, tune_loops


class Basis(NamedTuple):
    """How noise at knots becomes noise over time: `first` (T,) int, `weights` (T, 4) or None for one knot a step."""

    first: Any
    weights: Any


class Limits(NamedTuple):
    """Largest magnitude of a command, its largest change in a step, and the commands before the plan (C,)."""

    largest: Any
    change: Any
    before: Any


@scalar_function
def clip(value: Any, low: Any, high: Any) -> Any:
    """Value within [low, high]; NaN stays NaN."""
    value = low if value < low else value
    return high if value > high else value


@scalar_function
def _noise(noise: Any, at: Any, stride: Any, weights: Any) -> Any:
    """Noise of the sample at index `at`: weighted sum over four knots from there on, or that knot alone for None."""
    if weights is None:
        return noise[at]
    w0, w1, w2, w3 = weights
    return (w0 * noise[at] + w1 * noise[at + stride]) + (
        w2 * noise[at + U(2) * stride] + w3 * noise[at + U(3) * stride]
    )


@scalar_function
def _weights(weights: Any, t: int) -> Any:
    """Weights of the four knots that act at step t, or None."""
    if weights is None:
        return None
    return weights[t, 0], weights[t, 1], weights[t, 2], weights[t, 3]


@block_function
def expand(
    commands: Any, state: Any, history: int, nominal: Any, noise: Any, first: Any, basis: Any, limits: Any
) -> None:
    """Commands of one block of samples: nominal (T, C) plus noise, within the limits of magnitude and change.

    Writes `commands` from row history * C on; the block's noise begins at index `first` of `noise`. Uses row 0 of
    `state`.
    """
    tune_loops()
    horizon, channels = nominal.shape
    stride = U(channels) * BLOCK
    change, largest = limits.change, limits.largest
    for c in range(channels):
        kept = U(c) * BLOCK
        before = limits.before[c]
        for b in range(BLOCK):
            state[kept + b] = before
    for t in range(horizon):
        weights = _weights(basis.weights, t)
        first_knot = first + U(basis.first[t]) * stride
        first_row = U(history + t) * stride
        for c in range(channels):
            middle = nominal[t, c]
            kept = U(c) * BLOCK
            for b in range(BLOCK):
                previous = state[kept + b]
                value = middle + _noise(noise, first_knot + kept + b, stride, weights)
                value = clip(clip(value, previous - change, previous + change), -largest, largest)
                commands[first_row + kept + b] = value
                state[kept + b] = value


@block_function
def add_control_cost(costs: Any, first: Any, commands: Any, history: int, nominal: Any, scale: float) -> None:
    """Add scale * sum_t u_t (v_t - u_t) of one block's commands v about the nominal u to `costs[first:]`."""
    tune_loops()
    horizon, channels = nominal.shape
    for t in range(horizon):
        for c in range(channels):
            u = nominal[t, c]
            row = U((history + t) * channels + c) * BLOCK
            for b in range(BLOCK):
                costs[first + b] += scale * (u * (commands[row + b] - u))


@block_function
def add_weighted(sums: Any, weights: Any, first: Any, commands: Any, skip: Any, rows: int) -> None:
    """Add the block's commands, from row `skip` on, times its weights to the rows of `sums`."""
    tune_loops()
    for j in range(U(rows)):
        to, source = j * BLOCK, (skip + j) * BLOCK
        for b in range(BLOCK):
            sums[to + b] += weights[first + b] * commands[source + b]
