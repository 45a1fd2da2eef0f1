"""The sum of a row: of its own numbers only, to single precision, whatever their order of size."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.control.kernel import BLOCK, U
from disco_hw.control.kernel.sequences import row_sum
from disco_hw.jit import kernel_function

B = int(BLOCK)


@kernel_function
def run(rows, first):
    return row_sum(rows, U(first))


@given(st.integers(0, 2**32 - 1), st.integers(0, 2))
def test_a_row_is_summed(seed, row):
    rows = np.random.default_rng(seed).uniform(-1.0, 1.0, 3 * B).astype(np.float32)
    expected = rows[row * B : (row + 1) * B].astype(float).sum()
    np.testing.assert_allclose(run(rows, row * B), expected, atol=1e-5)


def test_what_is_not_finite_stays_visible():
    for at in range(B):
        for value in (np.nan, np.inf):
            rows = np.zeros(B, np.float32)
            rows[at] = value
            assert not np.isfinite(run(rows, 0))
