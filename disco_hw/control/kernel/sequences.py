"""Noise, and from it command sequences within the limits, one block at a time; and back; and sums over a block.

Random numbers are counter-based: every normal deviate is a pure function of (seed, step, sample, index). Philox
4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) gives the bits, Box-Muller the normal
deviates. There is no state to save: a plan can be drawn again bit for bit from its seed and step number.

Commands lie as rows of BLOCK samples: row (history + t) * C + c is channel c at step t, for C channels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from disco_hw.control.kernel import BLOCK, Floats, U
from disco_hw.jit import (
    bits_of_float,
    block_function,
    float32,
    float_from_bits,
    int32,
    scalar_function,
    tune_loops,
    uint32,
)

_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint32(0x9E3779B9), np.uint32(0xBB67AE85)
_LOW = np.uint64(0xFFFFFFFF)
_SHIFT = np.uint64(32)

_LN2 = np.float32(math.log(2.0))
_SQRT_HALF_BITS = np.int32(0x3F3504F3)
_MANTISSA_BITS = np.int32(23)
_TO_UNIT = np.float32(2.0**-24)
_TO_HALF_TURNS = np.float32(2.0**-32)
_ROUND_TO_INTEGER = np.float32(1.5 * 2.0**23)
_SIGN = np.uint32(0x80000000)
# Of sin(pi x) / x and cos(pi x) in x^2, least error for |x| <= 1/2 in single precision.
_SINE = tuple(np.float32(c) for c in (3.1415925, -5.1677022, 2.5499578, -0.5976252, 0.07643289))
_COSINE = tuple(np.float32(c) for c in (1.0, -4.9347954, 4.0584474, -1.3320621, 0.22000568))


@scalar_function
def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, int, int, int]:
    """Return four uniform uint32 from a counter of four and a key of two uint32 (Philox 4x32-10)."""
    for _ in range(10):
        product0 = _M0 * np.uint64(c0)
        product1 = _M1 * np.uint64(c2)
        c0, c1, c2, c3 = (
            uint32(product1 >> _SHIFT) ^ c1 ^ k0,
            uint32(product1 & _LOW),
            uint32(product0 >> _SHIFT) ^ c3 ^ k1,
            uint32(product0 & _LOW),
        )
        k0 = uint32(k0 + _W0)
        k1 = uint32(k1 + _W1)
    return c0, c1, c2, c3


@scalar_function
def natural_log(value: float) -> float:
    """Logarithm of a positive normal float32, relative error below 2e-7; branch-free, so that it vectorises."""
    bits = bits_of_float(value)
    # Exponent such that the mantissa lies in [sqrt(1/2), sqrt(2)).
    shifted = int32(bits - _SQRT_HALF_BITS)
    exponent = int32(shifted >> _MANTISSA_BITS)
    mantissa = float_from_bits(int32(bits - int32(exponent << _MANTISSA_BITS)))
    # ln m = 2 artanh(s) with s = (m - 1) / (m + 1), |s| < 0.172.
    s = (mantissa - float32(1.0)) / (mantissa + float32(1.0))
    q = s * s
    series = float32(2 / 3) + q * (float32(2 / 5) + q * (float32(2 / 7) + q * float32(2 / 9)))
    return float32(exponent) * _LN2 + s * (float32(2.0) + q * series)


@scalar_function
def _cos_sin_part(part: float, sign: int) -> tuple[float, float]:
    """Cosine and sine of pi * part for |part| <= 1/2, absolute error below 2e-7, with the bits of `sign` flipped."""
    q = part * part
    c0, c1, c2, c3, c4 = _COSINE
    s0, s1, s2, s3, s4 = _SINE
    cosine = c0 + q * (c1 + q * (c2 + q * (c3 + q * c4)))
    sine = part * (s0 + q * (s1 + q * (s2 + q * (s3 + q * s4))))
    return (float_from_bits(int32(bits_of_float(cosine) ^ sign)), float_from_bits(int32(bits_of_float(sine) ^ sign)))


@scalar_function
def cos_sin_half_turns(half_turns: float) -> tuple[float, float]:
    """Cosine and sine of pi * half_turns for |half_turns| < 2^22, absolute error below 3e-7 on top of its rounding."""
    # The sum's last bit is whether the nearest whole number is odd, and then both signs change.
    shifted = half_turns + _ROUND_TO_INTEGER
    return _cos_sin_part(half_turns - (shifted - _ROUND_TO_INTEGER), int32(bits_of_float(shifted) << np.int32(31)))


@scalar_function
def box_muller(bits0: int, bits1: int) -> tuple[float, float]:
    """Two independent standard normal deviates (float32) from two uniform uint32; magnitude at most 5.8."""
    # 24 bits are exact in float32; the offset keeps zero out of the logarithm.
    uniform = (float32(int32(bits0 >> np.uint32(8))) + float32(0.5)) * _TO_UNIT
    radius = math.sqrt(float32(-2.0) * natural_log(uniform))
    # One bit for the sign, the others for half a turn.
    part = float32(int32(uint32(bits1 << np.uint32(1)))) * _TO_HALF_TURNS
    cosine, sine = _cos_sin_part(part, int32(bits1 & _SIGN))
    return radius * cosine, radius * sine


@block_function
def fill_normal_block(noise: Floats, rows: int, block: int, step: int, seed: int, scale: float) -> None:
    """Fill block `block` of `noise` (blocks, rows, BLOCK) float32, flat, with normal deviates.

    `rows` is a multiple of four, `scale` the standard deviation. A deviate depends on nothing but (seed, step, sample,
    row): seed is the key, and step, sample and row are the counter.
    """
    tune_loops()
    k0, k1 = uint32(seed & 0xFFFFFFFF), uint32((seed >> 32) & 0xFFFFFFFF)
    c2, c3 = uint32(step & 0xFFFFFFFF), uint32((step >> 32) & 0xFFFFFFFF)
    first = U(block) * BLOCK
    at = U(block * rows) * BLOCK
    for four in range(rows // 4):
        for b in range(BLOCK):
            b0, b1, b2, b3 = philox(uint32(first + b), uint32(four), c2, c3, k0, k1)
            n0, n1 = box_muller(b0, b1)
            n2, n3 = box_muller(b2, b3)
            noise[at + b] = n0 * scale
            noise[at + BLOCK + b] = n1 * scale
            noise[at + U(2) * BLOCK + b] = n2 * scale
            noise[at + U(3) * BLOCK + b] = n3 * scale
        at += U(4) * BLOCK


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
    """Basis from noise at knots to noise over time: `first` (T,) int, `weights` (T, 4) or None for one knot a step."""

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
    """Fill `pull` (R,) with the derivative of sum_t u_t eps_t by each row of knot noise, for the nominal u (T, C)."""
    horizon, channels = nominal.shape
    for r in range(pull.size):
        pull[r] = float32(0.0)
    for t in range(horizon):
        weights = _weights(basis.weights, t)
        for c in range(channels):
            _spread(pull, basis.first[t] * channels + c, channels, weights, nominal[t, c])


@block_function
def add_sampled_control_cost(costs: Floats, first: int, noise: Floats, at: int, pull: Floats, scale: float) -> None:
    """Add the control cost as `add_control_cost` does, but of the noise as drawn, by `pull_on_knots`."""
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
