"""Counter-based random numbers: every normal deviate is a pure function of (seed, step, sample, index).

Philox 4x32-10 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) gives the bits, Box-Muller the
normal deviates. There is no state to save: a plan can be drawn again bit for bit from its seed and step number.
"""

from __future__ import annotations

import math

import numpy as np

from disco_hw.control.kernel.layout import BLOCK, Floats, U
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
_WHOLE = np.float32(1.5 * 2.0**23)
_SIGN = np.uint32(0x80000000)
# Of sin(pi x) / x and cos(pi x) in x^2, least error for |x| <= 1/2 in single precision.
_SINE = tuple(np.float32(c) for c in (3.1415925, -5.1677022, 2.5499578, -0.5976252, 0.07643289))
_COSINE = tuple(np.float32(c) for c in (1.0, -4.9347954, 4.0584474, -1.3320621, 0.22000568))


@scalar_function
def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, int, int, int]:
    """Philox 4x32-10: four uniform uint32 from a counter of four and a key of two uint32."""
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
    return (
        float_from_bits(int32(bits_of_float(cosine) ^ sign)),
        float_from_bits(int32(bits_of_float(sine) ^ sign)),
    )


@scalar_function
def cos_sin_half_turns(half_turns: float) -> tuple[float, float]:
    """Cosine and sine of pi * half_turns for |half_turns| < 2^22, absolute error below 3e-7 on top of its rounding."""
    # The sum's last bit is whether the nearest whole number is odd, and then both signs change.
    shifted = half_turns + _WHOLE
    return _cos_sin_part(half_turns - (shifted - _WHOLE), int32(bits_of_float(shifted) << np.int32(31)))


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
