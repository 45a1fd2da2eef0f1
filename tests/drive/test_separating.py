"""Each script holds what it says it distinguishes, both ways, and nothing that would blur it."""

import numpy as np
import pytest

from disco_hw.drive.scripts import PURPOSES, separating

TOP_RAD_S = 6.0


def driven(name):
    """Forward and turn to the left (n, 2), rad/s, every 20 ms."""
    script = separating(name, TOP_RAD_S)
    wheels = np.array([script.at(t_s) for t_s in np.arange(0.0, script.duration_s, 0.02)])
    return np.column_stack([wheels.mean(axis=1), 0.5 * (wheels[:, 1] - wheels[:, 0])])


def speeds(values):
    """The speeds that are held both ways."""
    constant_speeds = set(np.round(values[np.abs(values) > 0.1], 6))
    return {value for value in constant_speeds if value > 0.0 and -value in constant_speeds}


def test_straights_go_both_ways_at_two_speeds_and_never_turn():
    forward, turn = driven("straights").T
    assert len(speeds(forward)) == 2
    assert not turn.any()


def test_spins_turn_both_ways_at_two_rates_on_the_spot():
    forward, turn = driven("spins").T
    assert len(speeds(turn)) == 2
    assert np.abs(forward).max() < 1e-12


def test_curves_turn_both_ways_at_two_speeds_while_they_go_forward():
    forward, turn = driven("curves").T
    assert len(speeds(turn)) == 2
    assert (forward[turn != 0.0] > 0.0).all()
    assert np.unique(np.round(forward[turn != 0.0], 6)).size == 2


def test_starts_are_many_and_reach_two_speeds_both_ways():
    forward, turn = driven("starts").T
    begins = (forward[:-1] == 0.0) & (np.abs(forward[1:]) > 0.45 * TOP_RAD_S)
    assert np.count_nonzero(begins) == 12
    assert {np.sign(value) for value in forward[1:][begins]} == {1.0, -1.0}
    assert np.ptp(turn) > 0.5 * TOP_RAD_S
    assert speeds(forward[turn == 0.0]) == {TOP_RAD_S, 0.5 * TOP_RAD_S}


def test_ramps_cross_zero_slowly():
    for values in driven("ramps").T:
        crossings = np.flatnonzero(values[:-1] * values[1:] < 0.0)
        assert crossings.size >= 2
        assert np.abs(np.diff(values)).max() < 0.02 * 2.0 * TOP_RAD_S


def test_all_together_take_a_minute_and_serve_every_purpose():
    script = separating("separate", TOP_RAD_S)
    assert script.duration_s <= 60.0
    purposes = {manoeuvre.purpose for manoeuvre in script.manoeuvres}
    assert set(PURPOSES.values()) - {PURPOSES["separate"]} <= purposes


def test_all_together_turn_fast_and_go_straight_both_ways_at_either_end():
    forward, turn = driven("separate").T
    straight = np.where(turn == 0.0, forward, 0.0)
    for values, least in ((turn, 0.8 * TOP_RAD_S), (straight, 0.35 * TOP_RAD_S)):
        reached = np.flatnonzero(np.abs(values) > least)
        at_start, at_end = reached[reached < 0.2 * turn.size], reached[reached > 0.8 * turn.size]
        assert {np.sign(values[k]) for k in at_start} == {np.sign(values[k]) for k in at_end} == {1.0, -1.0}


def test_other_names_are_refused():
    with pytest.raises(KeyError):
        separating("loops", TOP_RAD_S)
