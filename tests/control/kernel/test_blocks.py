"""Buffers: on a cache line, of the size asked for; blocks that hold all samples."""

import numpy as np
import pytest

from disco_hw.control.kernel.blocks import BLOCK, aligned_zeros, block_count


@pytest.mark.parametrize(("size", "dtype"), [(1, np.float32), (80, np.float32), (33, np.float64), (7, np.int64)])
def test_buffers_begin_on_a_cache_line_and_are_zero(size, dtype):
    # Several, kept, so that the allocator cannot give every one the same lucky place.
    for buffer in [aligned_zeros(size, dtype) for _ in range(8)]:
        assert buffer.ctypes.data % 64 == 0
        assert (buffer.shape, buffer.dtype) == ((size,), np.dtype(dtype))
        assert not buffer.any()
        buffer[:] = 1


@pytest.mark.parametrize(("samples", "blocks"), [(1, 1), (79, 1), (80, 1), (81, 2), (400, 5), (25_600, 320)])
def test_the_last_block_may_be_partly_idle(samples, blocks):
    assert block_count(samples) == blocks
    assert blocks * int(BLOCK) >= samples > (blocks - 1) * int(BLOCK)
