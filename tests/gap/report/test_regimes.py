"""Residuals by regime: each node lies where the wheels say it does, and what disagrees is told first."""

import numpy as np

from disco_hw.gap.data.layout import BODY
from disco_hw.gap.report.regimes import Regime, in_words, masks_at_nodes, regimes
from tests.gap.synthetic import body_channel, line_of


def test_nodes_lie_in_the_regimes_that_the_wheels_tell():
    rest, ahead, back, left = [0.0, 0.0], [4.0, 4.0], [-4.0, -4.0], [1.0, 5.0]
    parts = masks_at_nodes(line_of(np.repeat([rest, ahead, back, left], 300, axis=0)))
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
    assert in_words([quiet]) == "nowhere more than noise"
    assert in_words([quiet, loud]) == "most turning left (3.0 times the noise)"
