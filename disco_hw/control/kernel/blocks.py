"""Samples are worked on in blocks of fixed size: how the buffers of a block are laid out, and how they are made."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

# All indices in the hot loops are unsigned: a signed one is checked for wrap-around at every access. All buffers are
# flat with rows at constant distances, which spares the compiler most checks for overlap.
U = np.uintp
BLOCK = U(80)

STATE_ROWS = 55

_CACHE_LINE = 64


def aligned_zeros(size: int, dtype: type = np.float32) -> NDArray[np.floating]:
    """A flat array of zeros that starts on a cache line, so that no vector of a row straddles two."""
    raw = np.zeros(size * np.dtype(dtype).itemsize + _CACHE_LINE, np.uint8)
    offset = -raw.ctypes.data % _CACHE_LINE
    return raw[offset : offset + size * np.dtype(dtype).itemsize].view(dtype)


def block_count(samples: int) -> int:
    """Blocks needed for `samples`; the last one may be partly idle."""
    return math.ceil(samples / int(BLOCK))
