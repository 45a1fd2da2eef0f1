"""Counter-based normals: known answers, the distribution, and independence of everything but the key."""

import numpy as np
import pytest
from scipy import stats

from disco_hw.control.kernel import BLOCK, aligned_zeros
from disco_hw.control.kernel.sequences import cos_sin_half_turns, fill_normal_block, philox
from disco_hw.jit import kernel_function


@kernel_function
def raw(c0, c1, c2, c3, k0, k1):
    return philox(c0, c1, c2, c3, k0, k1)


@kernel_function
def fill(noise, rows, blocks, step, seed, scale):
    for block in range(blocks):
        fill_normal_block(noise, rows, block, step, seed, scale)


@kernel_function
def cos_sin(half_turns, cosine, sine):
    for i in range(half_turns.size):
        cosine[i], sine[i] = cos_sin_half_turns(half_turns[i])


def normals(rows, blocks, step=0, seed=1, scale=1.0):
    noise = aligned_zeros(blocks * rows * int(BLOCK))
    fill(noise, rows, blocks, step, seed, np.float32(scale))
    return noise.reshape(blocks, rows, int(BLOCK))


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ([0] * 6, [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]),
        ([0xFFFFFFFF] * 6, [0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD]),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0],
            [0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1],
        ),
    ],
)
def test_philox_gives_the_published_answers(words, answer):
    assert list(raw(*(np.uint32(word) for word in words))) == answer


def test_normals_are_standard_normal_and_uncorrelated():
    draws = normals(8, 500, seed=12).astype(float)
    flat = draws.ravel()
    assert stats.kstest(flat, "norm").pvalue > 1e-3
    assert flat.mean() == pytest.approx(0.0, abs=0.01)
    assert flat.std() == pytest.approx(1.0, abs=0.01)
    assert stats.kurtosis(flat) == pytest.approx(0.0, abs=0.05)
    assert 4.0 < np.abs(flat).max() < 5.9
    rows = draws.swapaxes(0, 1).reshape(8, -1)
    np.testing.assert_allclose(np.corrcoef(rows), np.eye(8), atol=0.02)


def test_a_deviate_depends_on_seed_step_sample_and_row_alone():
    small, large = normals(4, 2), normals(12, 5)
    np.testing.assert_array_equal(small, large[:2, :4])
    np.testing.assert_array_equal(normals(4, 2, scale=2.0), 2.0 * small)
    for other in (normals(4, 2, step=1), normals(4, 2, seed=2), normals(4, 2, seed=1 + 2**32)):
        assert not np.any(other == small)


def test_cosine_and_sine_are_right_over_many_turns():
    half_turns = np.linspace(-40.0, 40.0, 160_001).astype(np.float32)
    found = np.empty((2, half_turns.size), np.float32)
    cos_sin(half_turns, *found)
    angle = np.pi * half_turns.astype(float)
    np.testing.assert_allclose(found, [np.cos(angle), np.sin(angle)], rtol=0.0, atol=3e-7)
    for value in (np.nan, np.inf, -np.inf):
        cos_sin(np.full(1, value, np.float32), found[0], found[1])
        assert np.isnan(found[:, 0]).all()
