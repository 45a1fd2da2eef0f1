"""How a set of effects is fitted: from which sets and starts, how a scanned entry is searched, what it promises."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.search import selection
from disco_hw.gap.search.least_squares import Fit, fit
from disco_hw.gap.search.richest_model import Candidate, Profile
from disco_hw.gap.search.selection import Selector
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import LIMITS, fit_at, vector_of

# Half a score is a gain in nats.
WORTH = 0.5 * LIMITS.score


class Growing(Selector):
    """A search that keeps from which sets larger ones are fitted: by 1 nat better than the set they begin from."""

    def __init__(self, channel, known):
        super().__init__(channel, lambda small, big: 1.0, LIMITS)
        self.fits = {frozenset(names): fit_at(cost) for names, cost in known.items()}
        self.begun = []

    def _with(self, parent, names, new):
        self.begun.append((parent.cost, new.name))
        return fit_at(parent.cost - 1.0)


def test_a_set_is_fitted_from_every_smaller_one_that_is_known_and_the_best_is_kept():
    both = ("turn_slip", "side_slip")
    known = {(): 90.0, ("turn_slip",): 50.0, ("side_slip",): 40.0}
    grown = Growing(None, known)
    assert grown.fit(both).cost == 39.0
    assert grown.begun == [(40.0, "turn_slip"), (50.0, "side_slip")]
    one = Growing(None, {(): 90.0, ("side_slip",): 40.0})
    assert one.fit(both).cost == 39.0
    assert one.begun == [(40.0, "turn_slip")]
    # Where none is known, without the last one that was taken.
    none = Growing(None, {(): 90.0})
    assert none.fit(both).cost == 88.0
    assert none.begun == [(90.0, "turn_slip"), (89.0, "side_slip")]


@pytest.fixture
def asked(monkeypatch):
    """What is fitted, and how: where it begins, in how many steps, whether loosely; costs are of 1 nat, then of 2..."""
    calls = []

    def keep(channel, begin, active, iterations=None, loose=False):
        calls.append((begin, iterations, loose))
        return fit_at(float(len(calls)))

    monkeypatch.setattr(selection, "fit", keep)
    return calls


PLACES = SimpleNamespace(place={"own.size": 0, "own.at": 1}, neutral=np.zeros(2), columns=("own.size", "own.at"))


def searching(closely=False, free=()):
    channel = SimpleNamespace(
        settings=DEFAULT_SETTINGS, layout=PLACES, free=free, residual=lambda vector: 10.0 * vector
    )
    return Selector(channel, lambda small, big: 1.0, LIMITS, closely=closely)


@pytest.mark.parametrize("closely", [False, True])
def test_every_start_is_tried_in_two_steps_and_the_best_fitted_to_the_end(asked, closely):
    parent = fit_at(9.0, (0.0, 7.0))
    found = searching(closely)._with(parent, (), Candidate("own", ("own.size",), lambda channel: ((3.0,), (4.0,))))
    assert found.cost == 3.0
    (first, *how), (second, *again), (best, *last) = asked
    assert (first.tolist(), second.tolist()) == ([3.0, 7.0], [4.0, 7.0])
    assert how == again == [2, not closely]
    assert best.cost == 1.0
    assert last == [None, not closely]


@pytest.mark.parametrize("closely", [False, True])
def test_a_scan_of_no_values_is_a_fit_from_the_smaller_set(asked, closely):
    parent = fit_at(9.0)
    new = Candidate("own", ("own.size",), profile=Profile("own.at", lambda channel: (), 0.5))
    searching(closely)._with(parent, (), new)
    assert asked == [(parent, None, not closely)]


def test_a_scanned_value_is_fitted_from_what_is_known_beside_it(asked):
    new = Candidate("own", ("own.size",), profile=Profile("own.at", lambda channel: (), 0.5))

    def begun(size, active, closely=False):
        start = Fit(np.array([size, 1.0]), (0,), 9.0, np.array([5.0]), np.full((1, 1), 6.0))
        searching(closely)._at(start, active, new, 2.0, 4)
        begin, iterations, loose = asked.pop()
        assert (iterations, loose) == (4, not closely)
        vector = begin.vector if isinstance(begin, Fit) else begin
        assert vector.tolist() == [size, 2.0]
        assert start.vector.tolist() == [size, 1.0]
        return begin

    # The same set at a neighbouring value lends its slope.
    near = begun(3.0, (0,))
    assert (near.residual.tolist(), near.slope.tolist(), near.carried) == ([30.0, 20.0], [[6.0]], True)
    # An effect that is not there yet begins where the fit without it ended, whenever it begins.
    idle = begun(0.0, (0, 1))
    assert (idle.residual.tolist(), idle.slope.tolist(), idle.carried) == ([5.0], [[6.0]], False)
    assert not begun(0.0, (0,), closely=True).carried
    # Else nothing is known there.
    assert isinstance(begun(3.0, (0, 1)), np.ndarray)
    assert isinstance(begun(3.0, (0,), closely=True), np.ndarray)


def test_an_effect_does_nothing_where_all_it_has_beside_the_scanned_entry_is_neutral():
    some = searching()
    both = SimpleNamespace(columns=("own.size", "own.at"))
    assert some._neutral(fit_at(0.0, (0.0, 0.0)), both)
    assert not some._neutral(fit_at(0.0, (0.0, 1.0)), both)
    assert not some._neutral(fit_at(0.0, (1.0, 1.0)), both)
    assert not some._neutral(fit_at(0.0, (0.0, 0.0)), SimpleNamespace(columns=()))


@pytest.mark.parametrize("closely", [False, True])
def test_a_set_is_fitted_anew_from_a_larger_one_only_where_that_is_clearly_better(monkeypatch, closely):
    both, rest = frozenset(("turn_slip", "side_slip")), frozenset({"turn_slip"})
    some, better = searching(closely), DEFAULT_SETTINGS.fit.enough_nats
    some.channel.layout = BODY
    some.fits = {rest: fit_at(9.0), both: fit_at(5.0, vector_of(turn_slip=0.2, side_slip=0.3))}
    some.proofs = {(rest, both): "with the worse fit", (frozenset(), both): "without it"}

    def refitted(of, cost):
        def fit(channel, begin, active, loose):
            # From where the larger one ended, but for what goes.
            np.testing.assert_array_equal(begin, vector_of(turn_slip=0.2))
            return fit_at(cost if loose is not closely else np.nan)

        monkeypatch.setattr(selection, "fit", fit)
        of._refit_without(("turn_slip", "side_slip"), "side_slip", ("turn_slip",))
        return of.fit(("turn_slip",)).cost, [*of.proofs.values()]

    every = ["with the worse fit", "without it"]
    assert refitted(some, 9.0 - better) == (9.0, every)
    # What is given stays, and what rests on a worse fit is proved anew.
    assert refitted(replace(some, given=("turn_slip",)), 1.0) == (9.0, every)
    assert refitted(some, 8.99 - better) == (8.99 - better, ["without it"])


class Scanned(Selector):
    """A search of one entry whose gain to first order is largest at 38.3 and whose fit is best at 41."""

    def _linear_gain(self, parent, new, value=None):
        self.looked_at.append(value)
        return 100.0 - (value - 38.3) ** 2

    def _at(self, start, active, new, value, iterations=None):
        self.tried.append((float(start.vector[0]), value, iterations))
        return fit_at((value - 41.0) ** 2, (value,))


def test_a_profiled_entry_is_searched_closer_to_first_order_and_then_by_fits():
    scanned = Scanned(SimpleNamespace(settings=DEFAULT_SETTINGS), lambda small, big: 1.0, LIMITS)
    new = SimpleNamespace(profile=Profile("entry", lambda channel: tuple(4.0 + 10.0 * k for k in range(7)), 0.625))
    first = (38.375 - 41.0) ** 2

    def found(cost):
        scanned.looked_at, scanned.tried = [], []
        return float(scanned._profiled(fit_at(cost), (), new).vector[0])

    assert found(first + WORTH) == 40.875
    # Half as far on either side of the best, until that is as close as it is searched.
    halved = [29.0, 39.0, 36.5, 41.5, 37.75, 40.25, 37.125, 38.375]
    assert scanned.looked_at == [*(4.0 + 10.0 * k for k in range(7)), *halved]
    rounds = [(38.375, 37.75), (38.375, 39.0), (39.0, 39.625), (39.625, 40.25), (40.25, 40.875)]
    assert scanned.tried == [(0.0, 38.375, None), *((*each, 2) for each in rounds)]
    # Where too little is gained the first fit is enough.
    assert found(first + WORTH - 0.01) == 38.375
    assert len(scanned.tried) == 1
    new.profile = Profile("entry", lambda channel: (34.0, 44.0), 0.625)
    assert found(first) == 38.375
    assert scanned.looked_at == [34.0, 44.0, *halved]


@pytest.mark.parametrize("size", [0.0, 1.5])
def test_what_is_promised_is_what_a_fit_gains_where_only_the_scanned_entry_bends(size):
    t = np.linspace(0.0, 3.0, 50)
    measured = 2.0 * t + 4.0 * np.sin(2.0 * t) + np.random.default_rng(1).standard_normal(t.size)
    layout = SimpleNamespace(
        step=np.full(3, 1e-3), low=np.full(3, -99.0), high=np.full(3, 99.0), neutral=np.zeros(3),
        precision=np.zeros(3), place={"base": 0, "own.size": 1, "own.at": 2},
    )  # fmt: skip

    def residual(vector):
        return vector[0] * t + vector[1] * np.sin(vector[2] * t) - measured

    channel = SimpleNamespace(settings=DEFAULT_SETTINGS, layout=layout, residual=residual)
    some = Selector(channel, lambda small, big: 1.0, LIMITS)
    parent = fit(channel, np.array([1.0, size, 1.0]), (0,))
    new = Candidate("own", ("own.size",), profile=Profile("own.at", lambda channel: (), 0.5))

    def least(rate):
        columns = np.column_stack([t, np.sin(rate * t)])
        left = columns @ np.linalg.lstsq(columns, measured, rcond=None)[0] - measured
        return 0.5 * float(left @ left)

    assert some._linear_gain(parent, new, 2.0) == pytest.approx(parent.cost - least(2.0), rel=1e-6)
    # At its own value; without one, as where nothing is scanned.
    for value in (1.0, None):
        assert some._linear_gain(parent, new, value) == pytest.approx(parent.cost - least(1.0), rel=1e-6)
