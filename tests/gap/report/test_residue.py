"""What is left is said where the richest model still gains, in several blocks of time, and nowhere else."""

import math

import numpy as np

from disco_hw.gap.report.residue import gain_by_block


def test_gain_and_its_scatter_come_from_blocks():
    block = np.repeat(np.arange(20), 30)
    even = np.full(600, 0.1)
    assert math.isclose(gain_by_block(even, block)[0], 60.0)
    assert gain_by_block(even, block)[1] < 1e-9
    once = np.where(block == 3, 2.0, 0.0)
    total, spread = gain_by_block(once, block)
    assert total == 60.0
    assert total < 3.0 * spread


def test_too_few_blocks_say_nothing():
    assert math.isinf(gain_by_block(np.ones(90), np.repeat(np.arange(3), 30))[1])
