"""The steps of a selection, each where it is told how much effects gain: what is taken, swapped, dropped, a rival."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.search import selection
from disco_hw.gap.search.evidence import EffectEvidence
from disco_hw.gap.search.richest_model import candidates_of
from disco_hw.gap.search.selection import Selector
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import LIMITS, fit_at, is_accepted

SETTINGS = DEFAULT_SETTINGS.selection
A, B, C, D = "turn_slip", "side_slip", "lateral_icr", "slope"


class Told(Selector):
    """A search in which an effect is worth the nats of the set it comes to, less what `worths` says of the set."""

    def __init__(self, worths, given=(), **settings):
        chosen = replace(DEFAULT_SETTINGS, selection=replace(SETTINGS, **settings))
        super().__init__(SimpleNamespace(settings=chosen, count=1000, layout=BODY), lambda *_: 1.0, LIMITS, given)
        self.worths = {frozenset(names): worth for names, worth in worths.items()}

    def promise(self, accepted, name):
        worths = self.worths
        return worths.get(frozenset((*accepted, name)), -90.0) - worths.get(frozenset(accepted), -90.0)

    def _worth(self, rest, accepted, name):
        return self.promise(rest, name)

    def acceptable(self, smaller, larger):
        return self.worths.get(frozenset(larger), -90.0) > self.worths.get(frozenset(smaller), -90.0)

    def _refit_without(self, accepted, name, rest):
        assert name not in rest


def test_what_promises_more_than_its_price_is_ranked():
    some = Told({(): 0.0, (A,): 0.0, (B,): 0.1, (C,): 7.0})
    assert some.ranked(()) == [C, B]


def test_an_effect_is_swapped_for_the_one_that_is_worth_most_more_than_it():
    both = {(A, B): 9.0, (A,): 2.0, (B,): 3.0}
    least = SETTINGS.telling_nats
    # By no more than it takes nothing is swapped.
    assert Told({**both, (C, B): 9.0 + least}).swapped((A, B)) == (A, B)
    assert Told({**both, (C, B): 9.1 + least}).swapped((A, B)) == (C, B)
    assert Told({**both, (C, B): 9.2 + least, (A, D): 9.1 + least}).swapped((A, B)) == (C, B)
    assert Told({**both, (C, B): 9.1 + least, (A, D): 9.2 + least}).swapped((A, B)) == (A, D)
    # Both, one after the other.
    assert Told({**both, (C, B): 15.0, (C, D): 19.0}).swapped((A, B)) == (C, D)
    # What is given stays, and what comes behind it does not.
    given = Told({**both, (C, B): 15.0, (A, D): 13.0}, given=(A,))
    assert given.swapped((A, B)) == (A, D)


def test_what_the_others_make_unnecessary_goes_and_what_is_given_stays():
    worths = {(A, B, C): 9.0, (B, C): 8.0, (A, C): 9.5, (A, B): 9.0, (A,): 3.0, (C,): 9.0, (B,): 7.0, (): 0.0}
    assert Told(worths).needed((A, B, C)) == (A, C)
    assert Told({**worths, (C,): 9.6}).needed((A, B, C)) == (C,)
    assert Told({**worths, (C,): 9.6}, given=(A,)).needed((A, B, C)) == (A, C)


def test_rivals_are_those_that_are_worse_by_less_than_it_takes_to_tell():
    told = Told({(A, B): 9.0, (B,): 0.0, (C, B): 9.0 - SETTINGS.telling_nats, (D, B): 9.1 - SETTINGS.telling_nats})
    assert told.rivals((A, B), A) == (D,)
    assert C in candidates_of(BODY)


@pytest.mark.parametrize(
    ("smaller", "larger", "parameters"),
    [((), ("surface_change",), 3.0), ((A,), (A, "surface_change"), 3.0), ((), (A, "surface_change"), 4.0)],
)
def test_what_repeats_of_what_happens_once_pays_for_all_that_is_new(smaller, larger, parameters):
    # In noise that is 1.2 times what was thought.
    price = 0.5 * 1.2 * (parameters * np.log(1000))
    for repeated, accepted in ((price, False), (1.001 * price, True)):
        assert is_accepted(smaller, larger, EffectEvidence(50.0, 40.0, repeated, repeated, 1.2, 99.0)) == accepted


@pytest.mark.parametrize(
    ("name", "without_best", "without_two", "accepted"),
    [
        # An effect that does not begin at some time has to repeat, however little.
        (A, 0.01, 70.0, True),
        (A, 0.0, 70.0, False),
        # In a third place each has to be worth a parameter: half of ln 1000.
        (A, 70.0, 3.49, True),
        (A, 70.0, 3.42, False),
        ("surface_change", 70.0, 3.49, True),
        ("surface_change", 70.0, 3.42, False),
    ],
)
def test_every_effect_repeats_and_shows_beside_the_two_blocks_that_say_most(name, without_best, without_two, accepted):
    proof = EffectEvidence(90.0, 80.0, without_best, without_two, 1.2, 99.0)
    assert is_accepted((), (name,), proof) == accepted


def test_evidence_pays_for_the_parameters_that_are_new(monkeypatch):
    prices = []
    monkeypatch.setattr(selection, "compare", lambda small, big, channel, parameters: prices.append(parameters))
    chosen = Selector(None, lambda small, big: 1.0, LIMITS)
    chosen.fits = dict.fromkeys((frozenset({A}), frozenset({A, "surface_change"})), SimpleNamespace(loose=False))
    chosen.evidence((A,), (A, "surface_change"))
    assert prices == [3]


@pytest.mark.parametrize(("more", "is_fitted"), [(1e-9, True), (-0.1, False)])
def test_what_may_reach_the_score_is_fitted_before_it_is_ranked(more, is_fitted):
    gain = 0.5 * (LIMITS.score + np.log(1000)) + more
    chosen = Selector(SimpleNamespace(settings=DEFAULT_SETTINGS, count=1000), lambda small, big: 1.0, LIMITS)
    chosen.fits[frozenset()] = fit_at(50.0)
    chosen._linear_gain = lambda parent, new: gain
    chosen._with = lambda parent, names, new: replace(parent, cost=20.0)
    told = chosen.promise((), A)
    assert told == pytest.approx((30.0 if is_fitted else gain) - 0.5 * np.log(1000))
