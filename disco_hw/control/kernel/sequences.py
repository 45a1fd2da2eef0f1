"""From noise to command sequences within the limits, one block of samples at a time; and back; and sums over a block.

Commands lie as rows of BLOCK samples: row (history + t) * C + c is channel c at step t, for C channels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from disco_hw.control.kernel.layout import BLOCK, Floats, U
from disco_hw.jit import block_function, float32, scalar_function, tune_loops

# Any, here and below: numba's compiler and its code generator have no types.
_intrinsic: Any = intrinsic
_LANES = 16
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, _LANES)
_BYTES = 4


@_intrinsic
def row_sum(_context: Any, row: Any, first: Any) -> tuple[Any, Callable[..., Any]]:
    """Sum of the BLOCK numbers of a flat float32 array from index `first` on, always in the same order."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data

        def part(number: int) -> Any:
            at = builder.add(arguments[1], ir.Constant(arguments[1].type, number * _LANES))
            pointer = builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer())
            return builder.load(pointer, align=_BYTES)

        total = part(0)
        for number in range(1, int(BLOCK) // _LANES):
            total = builder.fadd(total, part(number))
        width = _LANES
        while width > 1:
            width //= 2
            lanes = ir.VectorType(ir.IntType(32), width)
            low, high = (ir.Constant(lanes, list(range(begin, begin + width))) for begin in (0, width))
            total = builder.fadd(builder.shuffle_vector(total, total, low), builder.shuffle_vector(total, total, high))
        return builder.extract_element(total, ir.Constant(ir.IntType(32), 0))

    return types.float32(row, types.uintp), generate


# Weights of the four knots that act at a step, or None for one knot a step.
Taps: TypeAlias = tuple[float, float, float, float] | None


class Basis(NamedTuple):
    """How noise at knots becomes noise over time: `first` (T,) int, `weights` (T, 4) or None for one knot a step."""

    first: NDArray[np.int64]
    weights: Floats | None


class Limits(NamedTuple):
    """Largest magnitude of a command, its largest change in a step, and the commands before the plan (C,)."""

    largest: float
    change: float
    before: Floats


@scalar_function
def clip(value: float, low: float, high: float) -> float:
    """Value within [low, high]; NaN stays NaN."""
    value = low if value < low else value
    return high if value > high else value


@scalar_function
def _with_noise(middle: float, noise: Floats, at: int, stride: int, weights: Taps) -> float:
    """`middle` plus the noise at index `at`: of four knots from there on by their weights, or of one alone for None."""
    if weights is None:
        return middle + noise[at]
    w0, w1, w2, w3 = weights
    value = middle + w0 * noise[at]
    value += w1 * noise[at + stride]
    value += w2 * noise[at + U(2) * stride]
    return value + w3 * noise[at + U(3) * stride]


@scalar_function
def _weights(weights: Floats | None, t: int) -> Taps:
    """Weights of the four knots that act at step t, or None."""
    if weights is None:
        return None
    return weights[t, 0], weights[t, 1], weights[t, 2], weights[t, 3]


@block_function
def expand(
    commands: Floats,
    state: Floats,
    history: int,
    nominal: Floats,
    noise: Floats,
    first: int,
    basis: Basis,
    limits: Limits,
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
                value = _with_noise(middle, noise, first_knot + kept + b, stride, weights)
                value = clip(clip(value, previous - change, previous + change), -largest, largest)
                commands[first_row + kept + b] = value
                state[kept + b] = value


@block_function
def add_control_cost(costs: Floats, first: int, commands: Floats, history: int, nominal: Floats, scale: float) -> None:
    """Add scale * sum_t u_t (v_t - u_t) of one block's commands v about the nominal u to `costs[first:]`."""
    tune_loops()
    horizon, channels = nominal.shape
    for t in range(horizon):
        for c in range(channels):
            u = nominal[t, c]
            row = U((history + t) * channels + c) * BLOCK
            for b in range(BLOCK):
                costs[first + b] += scale * (u * (commands[row + b] - u))


@scalar_function
def _spread(pull: Floats, row: int, channels: int, weights: Taps, value: float) -> None:
    """Add a value at a step to the rows of the four knots that act there, or to that of its one knot for None."""
    if weights is None:
        pull[row] += value
    else:
        for j in range(4):
            pull[row + j * channels] += weights[j] * value


@block_function
def pull_on_knots(pull: Floats, nominal: Floats, basis: Basis) -> None:
    """How sum_t u_t eps_t grows with each row of noise, `pull` (R,): the nominal u (T, C) through the basis."""
    horizon, channels = nominal.shape
    for r in range(pull.size):
        pull[r] = float32(0.0)
    for t in range(horizon):
        weights = _weights(basis.weights, t)
        for c in range(channels):
            _spread(pull, basis.first[t] * channels + c, channels, weights, nominal[t, c])


@block_function
def add_drawn_control_cost(costs: Floats, first: int, noise: Floats, at: int, pull: Floats, scale: float) -> None:
    """As `add_control_cost`, but of the noise as drawn, which begins at index `at` of `noise`, by `pull_on_knots`."""
    tune_loops()
    for r in range(U(pull.size)):
        slope = scale * pull[r]
        row = at + r * BLOCK
        for b in range(BLOCK):
            costs[first + b] += slope * noise[row + b]


@block_function
def add_weighted(
    sums: Floats, weights: Floats, first_block: int, blocks: int, values: Floats, stride: int, skip: int, rows: int
) -> None:
    """Add blocks of values, times their weights, to the rows of `sums`.

    A block has `rows` rows in `values`, from row `skip` of it on, and begins `stride` after the one before it.
    """
    tune_loops()
    for j in range(U(rows)):
        to, source = j * BLOCK, (skip + j) * BLOCK
        for block in range(U(blocks)):
            at, weight = block * stride + source, (first_block + block) * BLOCK
            for b in range(BLOCK):
                sums[to + b] += weights[weight + b] * values[at + b]


@block_function
def sum_lanes(sums: Floats, rows: int) -> None:
    """Sum each row of BLOCK into its first entry, always in the same order."""
    tune_loops()
    for j in range(U(rows)):
        sums[j * BLOCK] = row_sum(sums, j * BLOCK)


@scalar_function
def mean_noise(sums: Floats, t: int, c: int, channels: int, basis: Basis) -> float:
    """Noise at step t of channel c, from the rows of noise in the first entries of the rows of `sums`."""
    row = U(basis.first[t] * channels + c) * BLOCK
    return _with_noise(float32(0.0), sums, row, U(channels) * BLOCK, _weights(basis.weights, t))
