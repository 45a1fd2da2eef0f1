import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from disco_hw.adaptation.adapter_link import Proposal
from disco_hw.adaptation.guard import BeliefGuard, Geometry, Outcome

S = 1_000_000_000
MEAN = np.array([0.238, 0.061, 0.415])
STD = np.array([0.004, 0.0006, 0.004])
LOW, HIGH = np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.5])


def guard():
    return BeliefGuard(Geometry(MEAN, np.diag(STD**2)), LOW, HIGH)


def proposal(t_s=10.0, mean=MEAN, std=STD, doubt="", covariance=None):
    matrix = np.diag(np.square(std)) if covariance is None else covariance
    return Proposal(round(t_s * S), "recursive", tuple(mean), tuple(np.ravel(matrix)), 10.0, doubt)


def judge(a_guard, a_proposal, late_s=0.0):
    return a_guard.judge(a_proposal.t_ns + round(late_s * S), a_proposal)


def test_a_narrower_belief_is_published():
    g = guard()
    verdict = judge(g, proposal(std=0.5 * STD))
    assert verdict.outcome is Outcome.PUBLISHED
    assert g.adapted
    assert g.in_force.std == pytest.approx(0.5 * STD)


def test_a_wider_belief_is_not():
    g = guard()
    assert judge(g, proposal(std=2.0 * STD)).outcome is Outcome.AGREES
    assert judge(g, proposal(std=STD * (0.5, 0.5, 1.2))).outcome is Outcome.AGREES
    assert not g.adapted


def test_a_jump_needs_two_later_confirmations():
    g = guard()
    far = MEAN * (1.0, 1.15, 1.0)
    assert judge(g, proposal(10.0, far)).outcome is Outcome.CONFIRMING
    assert judge(g, proposal(10.2, far)).outcome is Outcome.CONFIRMING
    assert judge(g, proposal(11.0, far)).outcome is Outcome.CONFIRMING
    verdict = judge(g, proposal(12.0, far))
    assert verdict.outcome is Outcome.PUBLISHED
    assert verdict.belief.mean == pytest.approx(far)


def test_the_same_second_confirms_nothing():
    g = guard()
    far = MEAN * (1.0, 1.15, 1.0)
    outcomes = [judge(g, proposal(10.0 + 0.1 * k, far)).outcome for k in range(8)]
    assert set(outcomes) == {Outcome.CONFIRMING}


def test_a_jump_that_the_next_window_contradicts_is_forgotten():
    g = guard()
    judge(g, proposal(10.0, MEAN * (1.0, 1.15, 1.0)))
    judge(g, proposal(11.0, MEAN * (1.0, 0.85, 1.0)))
    judge(g, proposal(12.0, MEAN * (1.0, 0.85, 1.0)))
    assert not g.adapted
    judge(g, proposal(13.0))
    assert judge(g, proposal(14.0, MEAN * (1.0, 0.85, 1.0))).outcome is Outcome.CONFIRMING


def test_a_confirmed_jump_may_be_wider_than_what_it_replaces():
    g = guard()
    far = MEAN * (1.0, 1.15, 1.0)
    outcomes = [judge(g, proposal(10.0 + k, far, 2.0 * STD)).outcome for k in range(3)]
    assert outcomes[-1] is Outcome.PUBLISHED


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"mean": (0.2, math.nan, 0.4)}, "finite"),
        ({"covariance": np.diag([1e-6, -1e-6, 1e-6])}, "covariance"),
        ({"covariance": [[1e-6, 2e-6, 0], [2e-6, 1e-6, 0], [0, 0, 1e-6]]}, "covariance"),
        ({"mean": (0.2, 0.06, 0.51)}, "outside"),
        ({"mean": (0.2, 0.006, 0.4), "std": (0.004, 0.001, 0.004)}, "impossible"),
        ({"doubt": "outside what was simulated"}, "outside what was simulated"),
    ],
)
def test_what_cannot_be_is_refused(wrong, words):
    g = guard()
    verdict = judge(g, proposal(**wrong))
    assert verdict.outcome is Outcome.REFUSED
    assert words in verdict.text
    assert not g.adapted


@pytest.mark.parametrize("late_s", [6.0, -6.0])
def test_what_is_old_or_from_the_future_is_refused(late_s):
    assert judge(guard(), proposal(std=0.5 * STD), late_s).outcome is Outcome.REFUSED


def test_two_changes_are_apart():
    g = guard()
    assert judge(g, proposal(10.0, std=0.5 * STD)).outcome is Outcome.PUBLISHED
    assert judge(g, proposal(11.0, std=0.2 * STD)).outcome is Outcome.AGREES
    assert judge(g, proposal(12.1, std=0.2 * STD)).outcome is Outcome.PUBLISHED


def test_restore_brings_the_model_back():
    g = guard()
    judge(g, proposal(std=0.5 * STD))
    g.restore()
    assert not g.adapted
    assert g.in_force.std == pytest.approx(STD)


numbers = st.floats(allow_nan=True, allow_infinity=True)


@given(st.tuples(numbers, numbers, numbers), st.lists(numbers, min_size=9, max_size=9), st.integers(0, 2**62))
def test_whatever_is_proposed_what_is_in_force_is_possible(mean, covariance, t_ns):
    g = guard()
    for later in range(4):
        g.judge(t_ns + later * S, Proposal(t_ns + later * S, "recursive", mean, tuple(covariance), 1.0))
    assert np.isfinite(g.in_force.mean).all()
    assert (np.linalg.eigvalsh(g.in_force.covariance / np.outer(g.in_force.std, g.in_force.std)) > 0.0).all()
    assert ((g.in_force.mean >= LOW) & (g.in_force.mean <= HIGH)).all()
