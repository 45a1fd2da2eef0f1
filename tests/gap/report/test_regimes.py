"""Residuals sorted by regime: each node lies where the wheels say it does, what disagrees comes first.

What is left counts where the richest model still gains in several blocks of time.
"""

import math

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.report.misspecification import Regime, describe, gain_by_block, masks, regimes
from tests.gap.synthetic import body_channel, line_of


def test_nodes_lie_in_the_regimes_that_the_wheels_tell():
    rest, ahead, back, left = [0.0, 0.0], [4.0, 4.0], [-4.0, -4.0], [1.0, 5.0]
    parts = masks(line_of(np.repeat([rest, ahead, back, left], 300, axis=0)))
    middle = dict(zip(("rest", "ahead", "back", "left"), (150, 450, 750, 1050), strict=True))
    assert {name for name, node in middle.items() if parts["standstill"][node]} == {"rest"}
    assert {name for name, node in middle.items() if parts["driving ahead"][node]} == {"ahead", "left"}
    assert {name for name, node in middle.items() if parts["driving back"][node]} == {"back"}
    assert {name for name, node in middle.items() if parts["turning left"][node]} == {"left"}
    assert not parts["turning right"].any()
    assert parts["speeding up"][300]
    assert not parts["speeding up"][450]
    assert parts["early"][0]
    assert parts["late"][-1]


@pytest.mark.parametrize(("other", "least", "most"), [(1.0, 0.0, 0.01), (1.6, 0.4, 0.6)])
def test_what_is_driven_at_one_speed_is_neither_slow_nor_fast(other, least, most):
    """Noise would tell them apart, and every value that goes with the speed would differ between them."""
    wheels = np.repeat([[2.0, 5.0], [2.0 * other, 5.0 * other]], 300, axis=0)
    noisy = wheels * (1.0 + 0.015 * np.random.default_rng(1).standard_normal(wheels.shape))
    parts = masks(line_of(noisy))
    assert parts["turning left"].all()
    for name in ("turning slowly", "turning fast"):
        assert least <= parts[name].mean() <= most


def test_a_fault_shows_in_its_regime_and_goes_with_its_effect():
    channel, _ = body_channel(turn_slip=0.1)
    missing = channel.neutral
    known = missing.copy()
    known[BODY.place["turn_slip.k_s"]] = 0.1
    found = regimes(channel, missing, known)
    by_name = {regime.name: regime for regime in found}
    assert by_name["turning fast"].before > 5.0
    assert by_name["straight"].before < by_name["turning fast"].before
    assert all(regime.after < 1.5 for regime in found)
    assert found[0].name.startswith("turning")


def test_only_what_is_louder_than_noise_is_worth_words():
    quiet, loud = Regime("straight", 1.1, 1.0, 100), Regime("turning left", 9.0, 1.0, 100)
    assert describe([quiet], 1.5) == "nowhere more than noise"
    assert describe([quiet, loud], 1.5) == "most turning left (3.0 times the noise)"


def test_gain_and_its_scatter_come_from_blocks():
    block = np.repeat(np.arange(20), 30)
    even = np.full(600, 0.1)
    assert math.isclose(gain_by_block(even, block, 4)[0], 60.0)
    assert gain_by_block(even, block, 4)[1] < 1e-9
    is_alternative = np.where(block == 3, 2.0, 0.0)
    total, spread = gain_by_block(is_alternative, block, 4)
    assert total == 60.0
    assert total < 3.0 * spread
    # Too few blocks say nothing.
    assert math.isinf(gain_by_block(np.ones(90), np.repeat(np.arange(3), 30), 4)[1])
