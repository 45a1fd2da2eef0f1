"""Terms without a name: which is tried, what it takes to be accepted, and whether a patch or a change is told."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search import channel_search
from disco_hw.gap.search.channel_result import ChannelResult, UnnamedTerm
from disco_hw.gap.search.channel_search import (
    _priced,
    _thresholds,
    _time_or_place,
    _with_one_more,
    _with_term,
    _written,
    best_terms,
    that_models_hold,
    with_unnamed,
)
from disco_hw.gap.search.evidence import EffectEvidence
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.search.selection import Selector, Thresholds
from disco_hw.gap.search.unnamed_terms import Term
from disco_hw.gap.settings import DEFAULT_SETTINGS, SelectionSettings
from tests.gap.synthetic import LIMITS, body_channel, moved_by, searched


class Linear:
    """A channel of 300 residuals, each of which feels one entry of what is added (150, 2); `asked` for so far."""

    settings = DEFAULT_SETTINGS
    count = 300

    def __init__(self, left, held=None):
        self.left, self.held, self.asked = left, held, []
        self.inner = self

    def split(self, vector):
        return vector, self.held

    def residual(self, core, extra):
        self.asked.append(np.zeros((150, 2)) if extra is None else extra)
        return self.left + self.asked[-1].ravel()

    def fitted(self, slope):
        left = self.residual(None, self.held)
        return Fit(np.zeros(slope.shape[1]), tuple(range(slope.shape[1])), 0.5 * float(left @ left), left, slope)


def along(*shares):
    """A term along some of the residuals."""
    perturbation = np.zeros(300)
    perturbation[: len(shares)] = shares
    return Term(str(shares), perturbation.reshape(150, 2))


NOTHING = Term("nothing", np.zeros((150, 2)))


def test_the_term_is_tried_that_takes_most_off_the_squares_and_only_if_that_may_be_worth_it():
    left = np.zeros(300)
    # Half their squares: 18.6, 32 and 17.4 nats.
    left[:3] = 6.1, -8.0, 5.9
    channel = Linear(left)
    small = channel.fitted(np.empty((300, 0)))
    first, second, third = along(3.0), along(0.0, 0.2), along(0.0, 0.0, -1.0)
    assert best_terms(small, channel, iter((NOTHING, first, second, third))) == ([second, first], 4)
    assert best_terms(small, channel, iter((second, first, NOTHING))) == ([second, first], 3)
    assert best_terms(small, channel, iter((first,))) == ([first], 2)
    assert best_terms(small, channel, iter((third, NOTHING, third))) == ([], 3)
    # Together 18.6 + 17.4 nats, in the right proportion.
    assert best_terms(small, channel, iter((second, along(6.1, 0.0, 5.9))))[0][0].form.startswith("(6.1")
    # No more than the four that promise most, and of patches, which are variations of one another, the best alone.
    many = [along(*np.eye(1, 3, 1)[0], *(0.1 * np.eye(1, 6, k)[0])) for k in range(6)]
    assert len(best_terms(small, channel, iter(many))[0]) == 4
    patches = [replace(one, disc=(0.0, 0.0, 1.0)) for one in (second, along(0.1, 1.0))]
    assert best_terms(small, channel, iter((first, *patches)))[0] == [patches[0], first]


def test_what_is_fitted_already_is_no_gain_of_a_term():
    rng = np.random.default_rng(0)
    slope, left = rng.standard_normal((300, 2)), 2.0 * rng.standard_normal(300)
    slope[:, 1] += 0.8 * slope[:, 0]
    # A fit that has not come to its end: what is left pulls along its own entries too.
    left += slope @ (0.3, -0.5)
    channel = Linear(left)
    small = channel.fitted(slope)

    def squares(columns):
        return float(np.linalg.lstsq(columns, left, rcond=None)[1][0])

    options = [
        Term(str(k), rng.standard_normal((150, 2)) + left.reshape(150, 2) * rng.uniform(0.1, 0.4)) for k in range(9)
    ]
    gains = [squares(slope) - squares(np.column_stack([slope, one.perturbation.ravel()])) for one in options]
    assert max(gains) > 36.0
    order = [options[k] for k in np.argsort(gains)[::-1] if gains[k] > 36.0][:4]
    assert best_terms(small, channel, iter(options))[0] == order


@pytest.mark.parametrize(("own", "tried"), [(0.09, False), (0.11, True)])
def test_a_term_of_which_what_is_fitted_does_the_most_is_not_tried(own, tried):
    left = np.zeros(300)
    left[1] = 100.0
    slope = np.zeros((300, 1))
    slope[0] = 2.0
    channel = Linear(left)
    term = along((1.0 - own) ** 0.5, own**0.5)
    assert best_terms(channel.fitted(slope), channel, iter((term,)))[0] == ([term] if tried else [])


def two(first, second):
    """A term of two features along some of the residuals."""
    return replace(along(*first), further_waves=(along(*second).perturbation,))


def test_features_that_belong_together_pay_for_each_but_one():
    for gain_nats, tried in ((20.65, False), (21.05, True)):
        # Worth 18 nats, and half of ln 300 for the second.
        left = np.zeros(300)
        left[:2] = gain_nats**0.5
        channel = Linear(left)
        term = two((3.0,), (0.0, 0.2))
        assert best_terms(channel.fitted(np.empty((300, 0))), channel, iter((term,)))[0] == ([term] if tried else [])
    # One that is nothing is none of them.
    left[:2] = 0.0, 6.1
    channel = Linear(left)
    silent = two((), (0.0, 1.0))
    assert best_terms(channel.fitted(np.empty((300, 0))), channel, iter((silent,)))[0] == [silent]


def test_what_is_fitted_already_leaves_all_features_together_too_little_and_others_are_tried():
    left, slope = np.zeros(300), np.zeros((300, 1))
    left[1], slope[0] = 100.0, 2.0
    channel = Linear(left)
    small = channel.fitted(slope)
    # The second feature has a twentieth of the squares, and nothing else is new.
    term, other = two((0.95**0.5,), (0.0, 0.05**0.5)), along(0.0, 1.0)
    assert best_terms(small, channel, iter((term, other)))[0] == [other]


@pytest.mark.parametrize("held", [None, np.full((150, 2), 0.7)])
def test_a_term_is_tried_in_a_size_that_hardly_matters_on_top_of_terms_that_are_there(held):
    channel = Linear(np.full(300, 9.0), held)
    small = channel.fitted(np.empty((300, 0)))
    channel.asked.clear()
    best_terms(small, channel, iter((along(50.0),)))
    before, tried = channel.asked
    assert (before == (0.0 if held is None else 0.7)).all()
    assert np.sqrt(((tried - before) ** 2).mean()) == pytest.approx(1e-3)


def turned_in(since, until, factor):
    """A drive whose turns are so much larger between two fractions of it, its channel, and the term that says so."""
    channel, line = body_channel()
    p = channel.neutral
    inside = (np.arange(line.t_s.size) >= since * line.t_s.size) & (np.arange(line.t_s.size) < until * line.t_s.size)
    perturbation = np.zeros((line.t_s.size, 3))
    perturbation[:, 2] = np.where(inside, p[0] / p[1] * (line.speed_rad_s[:, 1] - line.speed_rad_s[:, 0]), 0.0)
    return moved_by(channel, factor * perturbation), Term("omega += {:.2f} then", perturbation)


def test_a_term_is_accepted_with_its_number_and_its_evidence_and_what_stood_in_for_it_goes():
    channel, term = turned_in(0.3, 0.5, -0.15)
    other = replace(term, form="other", perturbation=np.roll(term.perturbation, 400, axis=0))
    found = with_unnamed(searched(channel, ("turn_slip",)), lambda found: iter((other, term)))
    assert found.names == ()
    (one,) = found.unnamed
    assert one.form == "omega += -0.15 then"
    assert one.term is term
    small, big = searched(channel).selector.exact(("turn_slip",)), one.evidence
    assert big.gain > 100.0
    # Its own parameter costs ln n, and the choice of one in two twice ln 2.
    price = np.log(channel.count) + 2.0 * np.log(2.0)
    assert big.score == pytest.approx(2.0 * big.gain / big.inflation - price)
    assert found.fit.cost < small.cost - 100.0
    assert found.fit.vector[-1] == pytest.approx(-0.15, abs=0.01)
    assert found.base.cost == pytest.approx(searched(channel).selector.exact(()).cost)
    assert found.base.vector.size == channel.neutral.size
    assert found.plain.channel is channel


@pytest.mark.parametrize(
    ("score", "prices", "moved_m", "accepted"),
    [
        (20.0, 1.5, 0.001, True),
        (19.9, 1.5, 0.1, False),
        (40.0, 1.01, 0.001, True),
        (40.0, 0.99, 0.1, False),
        (40.0, -1.0, 0.1, False),
        (40.0, 1.5, 0.0009, False),
    ],
)
def test_a_term_takes_its_score_holds_without_two_best_blocks_and_moves_predictions(
    monkeypatch, score, prices, moved_m, accepted
):
    channel, term = turned_in(0.3, 0.5, -0.15)
    without_two = prices * 0.5 * np.log(channel.count)
    proof = EffectEvidence(30.0, 10.0, 9.0, without_two, 1.0, score)
    monkeypatch.setattr(channel_search, "compare", lambda *_: proof)
    plain = ChannelResult(Selector(channel, lambda small, big: moved_m, LIMITS), (), channel)
    found = with_unnamed(plain, lambda found: iter((term,)))
    assert [one.evidence for one in found.unnamed] == ([proof] if accepted else [])


def test_a_patch_is_looked_for_closer_around_the_best(monkeypatch):
    channel, term = turned_in(0.3, 0.5, -0.15)
    rough = replace(
        term, form="rough {:.1f}", perturbation=np.roll(term.perturbation, 100, axis=0), disc=(1.0, 2.0, 0.5)
    )
    near = replace(term, disc=(1.1, 2.0, 0.5))
    asked = []

    def closer(inner, p, disc):
        asked.append((inner, disc))
        return iter((near, replace(near, perturbation=0.0 * term.perturbation)))

    monkeypatch.setattr(channel_search, "places_near", closer)
    found = with_unnamed(searched(channel), lambda found: iter((rough, rough, rough)))
    assert asked[0] == (channel, rough.disc)
    (one,) = found.unnamed
    assert one.term is near
    # Three were tried, and the best of them with two around it.
    price = np.log(channel.count) + 2.0 * np.log(6.0)
    assert one.evidence.score == pytest.approx(2.0 * one.evidence.gain / one.evidence.inflation - price)


def test_a_patch_is_worth_it_without_the_block_that_says_most(monkeypatch):
    channel, term = turned_in(0.3, 0.5, -0.15)
    patch = replace(term, disc=(0.0, 0.0, 0.5))
    # Of four that were tried: what a term costs, one parameter and the choice, and 20 more.
    price = np.log(channel.count) + 2.0 * np.log(4.0)
    nats = 0.5 * 1.3 * (20.0 + price)

    def with_term(one, *proof):
        monkeypatch.setattr(channel_search, "compare", lambda *_: EffectEvidence(90.0, 80.0, *proof))
        return _with_term(searched(channel), one, 4)

    for held_out_without_best, worth_it in ((1.001 * nats, True), (0.999 * nats, False)):
        larger, happened_again = with_term(patch, held_out_without_best, 0.0, 1.3, 99.0)
        assert happened_again is (larger is not None) is worth_it
    # Another term has to repeat, however little, and in a third place; what is not worth it is none.
    third = 0.5 * np.log(channel.count)
    assert with_term(term, 0.1, 1.02 * third, 1.3, 99.0)[0] is not None
    for less in ((0.999 * nats, 0.0), (0.0, 1.02 * third), (0.1, 0.98 * third)):
        assert with_term(term, *less, 1.3, 99.0) == (None, True)
    assert with_term(patch, 80.0, 80.0, 1.3, 19.0) == (None, True)
    again = EffectEvidence(90.0, 80.0, 30.0, 30.0, 1.5, 99.0).score_without_best(2.0, 1000)
    assert again == pytest.approx(2.0 * 30.0 / 1.5 - 2.0 * np.log(1000.0))


@dataclass(frozen=True)
class Searched:
    """What is looked at of a channel's search."""

    names: tuple = ("turn_slip", "surface_change")
    unnamed: tuple = ()
    price: float = 100.0
    given: tuple = ()
    either: tuple = ()
    vector: tuple = ()

    @property
    def reported(self):
        return SimpleNamespace(vector=np.array(self.vector))

    @property
    def channel(self):
        return SimpleNamespace(settings=DEFAULT_SETTINGS)

    @property
    def selector(self):
        return SimpleNamespace(given=self.given)


PATCH = UnnamedTerm("patch", None, replace(NOTHING, disc=(0.0, 0.0, 1.0)))
PLAIN = UnnamedTerm("plain", None, NOTHING)


def added(monkeypatch, *outcomes):
    """How many terms are added where these are found in turn, and whether each time patches were looked for."""
    asked, left = [], list(outcomes)

    def one_more(of, options, patches):
        assert options == "options"
        asked.append(patches)
        one, still = left.pop(0)
        return None if one is None else replace(of, unnamed=(*of.unnamed, one)), still

    monkeypatch.setattr(channel_search, "_with_one_more", one_more)
    monkeypatch.setattr(channel_search, "_written", lambda of: ("written", of.unnamed))
    told, terms = with_unnamed(Searched(), "options")
    assert told == "written"
    return terms, asked


def test_terms_are_added_until_none_is_accepted_and_no_more_than_three(monkeypatch):
    assert added(monkeypatch, (None, True)) == ((), [True])
    assert added(monkeypatch, (PLAIN, False), (None, False)) == ((PLAIN,), [True, False])
    assert added(monkeypatch, *[(PATCH, True), (PLAIN, False)] * 2) == ((PATCH, PLAIN, PATCH), [True, True, False])


def test_all_coefficients_are_told_as_they_are_when_all_terms_are_in():
    waves = UnnamedTerm("", None, replace(NOTHING, form="waves {:.2f}", further_waves=(NOTHING.perturbation,)))
    single = UnnamedTerm("", None, replace(NOTHING, form="single {:.2f}"))
    last = UnnamedTerm("", None, replace(NOTHING, form="last {:.2f}"))
    found = Searched(unnamed=(single, waves, last), vector=(9.0, 9.0, 0.25, 0.6, -0.8, 0.5))
    assert [one.form for one in _written(found).unnamed] == ["single 0.25", f"waves {0.5**0.5:.2f}", "last 0.50"]
    none = Searched(vector=(9.0,))
    assert _written(none) is none


@pytest.fixture
def one_more(monkeypatch):
    """Adds the first of some terms that is accepted; which were offered and tried, with how many, in turn."""
    offers, tries = [], []

    def made(options, accepted=(), is_alternative=(), closer=(), patches=True, channel=None):
        def best(fit, channel, offered):
            offers.append(terms := [*offered])
            return terms, len(terms)

        def tried(found, term, among):
            tries.append((term, among))
            return (("with", term), True) if term in accepted else (None, term not in is_alternative)

        offers.clear()
        tries.clear()
        monkeypatch.setattr(channel_search, "best_terms", best)
        monkeypatch.setattr(channel_search, "_with_term", tried)
        monkeypatch.setattr(channel_search, "places_near", lambda inner, p, disc: iter(closer))
        found = SimpleNamespace(
            fit=SimpleNamespace(vector=None), selector=SimpleNamespace(channel=None), channel=channel
        )
        return *_with_one_more(found, lambda of: iter(options) if of is found else None, patches), offers, tries

    return made


FIRST, SECOND, DISC, NEAR = (
    replace(NOTHING, form=form, disc=disc)
    for form, disc in (("first", None), ("second", None), ("disc", (1.0, 2.0, 0.5)), ("near", (1.1, 2.0, 0.5)))
)


def test_the_first_term_that_is_accepted_is_added(one_more):
    larger, patches, offers, tries = one_more([FIRST, SECOND, DISC], accepted=[SECOND, DISC])
    assert (larger, patches) == (("with", SECOND), True)
    assert offers == [[FIRST, SECOND, DISC]]
    assert tries == [(FIRST, 3), (SECOND, 3)]
    assert one_more([FIRST, SECOND])[:2] == (None, True)
    # Without patches.
    larger, patches, offers, _ = one_more([DISC, FIRST], accepted=[DISC], patches=False)
    assert (larger, patches, offers) == (None, False, [[FIRST]])


def test_where_a_patch_did_not_happen_again_none_is_looked_for_any_more(one_more):
    larger, patches, offers, tries = one_more([DISC, NEAR, FIRST], accepted=[NEAR, FIRST], is_alternative=[DISC])
    assert (larger, patches) == (("with", FIRST), False)
    assert offers == [[DISC, NEAR, FIRST], [FIRST]]
    assert tries == [(DISC, 3), (FIRST, 1)]


def test_a_patch_of_a_body_is_tried_where_it_lies_best_among_all_that_were_looked_at(one_more):
    body = object.__new__(BodyChannel)
    _, _, offers, tries = one_more([DISC, FIRST], accepted=[DISC], closer=[NEAR], channel=body)
    assert offers[1] == [DISC, NEAR]
    assert tries == [(DISC, 4)]
    assert one_more([FIRST, DISC], accepted=[DISC], closer=[NEAR], channel=body)[3] == [(FIRST, 2), (DISC, 4)]


@pytest.mark.parametrize(
    ("kept", "new_price", "names"),
    [
        (("slope",), 5.0, ("slope",)),
        (("slope", "again"), 9.5, ("slope", "again")),
        (("slope", "again"), 8.5, ("selected",)),
        ((), 9.5, ()),
        ((), 8.5, ("selected",)),
    ],
)
def test_names_that_a_term_changes_are_selected_anew_and_those_that_cost_less_are_kept(
    monkeypatch, kept, new_price, names
):
    prices, begun = {("selected",): new_price, kept: 9.0}, []

    class Stub:
        def __init__(self, channel, moves, thresholds, given, start):
            assert (given, start.tolist()) == (("given",), [1.0, 2.0, 0.0])
            self.fits, self.moves = {}, moves

        def select(self, begin=()):
            begun.append(begin)
            return kept if begin == ("slope",) else ("selected",)

        def priced(self, names):
            return prices[names]

    channel = SimpleNamespace(count=1000, neutral=np.zeros(3), split=lambda vector: vector)
    monkeypatch.setattr(channel_search.WithTerms, "of", lambda inner, terms: channel)
    monkeypatch.setattr(channel_search, "Selector", Stub)
    monkeypatch.setattr(channel_search, "indices", lambda *_: ())
    monkeypatch.setattr(channel_search, "fit", lambda channel, begin, active: SimpleNamespace(vector=begin))
    monkeypatch.setattr(channel_search, "compare", lambda *_: EffectEvidence(90.0, 80.0, 70.0, 60.0, 1.0, 99.0))
    selector = SimpleNamespace(
        exact=lambda names: SimpleNamespace(vector=np.array([3.0, 4.0])),
        fit=lambda given: SimpleNamespace(vector=np.array([1.0, 2.0])),
        moves=lambda small, big: 1.0,
        given=("given",),
        thresholds=LIMITS,
        channel=channel,
    )
    larger, happened_again = _with_term(ChannelResult(selector, ("slope",), None), FIRST, 2)
    assert larger.names == names
    # All names anew is what takes the time: only where it is asked for.
    assert begun == [("slope",)] + [()] * (kept != ("slope",))
    assert larger.plain is selector
    assert [one.term for one in larger.unnamed] == [FIRST]
    assert happened_again


@pytest.mark.parametrize("of", [WheelChannel, BodyChannel])
def test_terms_that_no_model_can_carry_make_room_for_others_and_for_names(monkeypatch, of):
    carried = replace(NOTHING, model_name="v_x += k v^3")
    options = {WheelChannel: (FIRST, carried), BodyChannel: (carried, SECOND, carried)}
    monkeypatch.setattr(channel_search, "_wheel_options", lambda found: iter(options[WheelChannel]))
    monkeypatch.setattr(channel_search, "_body_options", lambda found: iter(options[BodyChannel]))
    monkeypatch.setattr(channel_search, "with_unnamed", lambda bare, offered: (bare, [*offered(bare)]))
    plain = SimpleNamespace(select=lambda names: (*names, "selected"))
    terms = tuple(UnnamedTerm("", None, one) for one in (carried, FIRST))
    found = ChannelResult(None, ("slope",), object.__new__(of), terms, plain)
    bare, offered = that_models_hold(found)
    assert (bare.selector, bare.names, bare.unnamed, bare.plain) == (plain, ("slope", "selected"), (), None)
    assert offered == [one for one in options[of] if one is carried]
    for same in (replace(found, unnamed=terms[:1]), replace(found, unnamed=(), plain=None)):
        assert that_models_hold(same) is same


def told(monkeypatch, found, placed_price=90.0, placed_terms=(PATCH,), placed_names=("turn_slip",)):
    searches = []

    def named(one, options):
        searches.append(one.names)
        if "surface_change" in one.names:
            return one
        return replace(one, unnamed=placed_terms, price=placed_price, names=placed_names)

    monkeypatch.setattr(channel_search, "with_unnamed", named)
    monkeypatch.setattr(channel_search, "_priced", lambda one: one.price)
    return _time_or_place(found), searches


def test_a_patch_is_told_in_place_of_a_change_that_is_not_clearly_better(monkeypatch):
    change = Searched()
    clearly = 2.0 * DEFAULT_SETTINGS.selection.telling_nats
    both, searches = told(monkeypatch, change, 100.0 + 0.9 * clearly)
    assert searches == [("turn_slip", "surface_change"), ("turn_slip",)]
    assert (both.names, both.unnamed, both.either) == (("turn_slip",), (PATCH,), ("surface_change",))
    assert told(monkeypatch, change, 100.0 - 0.9 * clearly)[0].either == ("surface_change",)
    assert told(monkeypatch, change, 100.0 + clearly)[0] is change
    placed = told(monkeypatch, change, 100.0 - clearly)[0]
    assert (placed.names, placed.either) == (("turn_slip",), ())


def test_a_change_stays_where_no_patch_was_found_or_the_change_beside_it(monkeypatch):
    change = Searched()
    assert told(monkeypatch, change, placed_terms=(PLAIN,))[0] is change
    assert told(monkeypatch, change, placed_terms=())[0] is change
    assert told(monkeypatch, change, placed_terms=(PLAIN, PATCH))[0].unnamed == (PLAIN, PATCH)
    assert told(monkeypatch, change, placed_names=("turn_slip", "surface_change"))[0] is change


def test_without_a_change_of_the_floor_or_with_a_known_one_no_patch_competes(monkeypatch):
    plain = Searched(("turn_slip",))
    assert told(monkeypatch, plain)[1] == [("turn_slip",)]
    known = replace(plain, names=("surface_change",), given=("surface_change",))
    assert told(monkeypatch, known)[1] == [("surface_change",)]


def test_the_price_of_a_patch_is_that_of_four_numbers_and_of_a_term_one():
    def priced(names, unnamed, count=1000):
        channel = SimpleNamespace(settings=DEFAULT_SETTINGS, count=count)
        return _priced(SimpleNamespace(names=names, unnamed=unnamed, channel=channel, fit=SimpleNamespace(cost=50.0)))

    each = 0.5 * np.log(1000)
    assert priced((), ()) == 50.0
    assert priced(("slope",), ()) == pytest.approx(50.0 + 2.0 * each)
    assert priced(("slope",), (PATCH,)) == pytest.approx(50.0 + 6.0 * each)
    assert priced(("slope",), (PLAIN, PATCH)) == pytest.approx(50.0 + 7.0 * each)
    assert priced(("slope",), (), 1) == pytest.approx(50.0 + np.log(2.0))


def heavy(white, use=None):
    white = np.asarray(white, dtype=float)
    settings = SelectionSettings(named_score=4.0, unnamed_score=20.0, least_moved_m=0.002)
    return _thresholds(white, np.ones(white.shape[0], dtype=bool) if use is None else np.asarray(use), settings)


def test_the_heavier_the_tails_of_the_noise_the_more_evidence_it_takes():
    # A fourth of the samples twice and the rest nothing like as large: a kurtosis of 3.6 and of 12.8 over 3.
    some = np.array([[3.0, 3.0]] * 9 + [[0.5, 0.5]] * 32)
    kurtosis = (some**4).mean() / (some**2).mean() ** 2
    assert 1.0 < kurtosis / 3.0 < 1.5
    assert heavy(some) == Thresholds(pytest.approx(4.0 * kurtosis / 3.0), 0.002, pytest.approx(20.0 * kurtosis / 3.0))
    few = np.array([[5.0, 5.0]] + [[0.1, 0.1]] * 60)
    assert heavy(few) == Thresholds(6.0, 0.002, 30.0)
    # Light ones do not make it easier.
    assert heavy(np.ones((40, 2))) == Thresholds(4.0, 0.002, 20.0)


def test_only_samples_that_are_used_and_say_something_tell_of_tails():
    some = np.array([[3.0, 3.0]] * 9 + [[0.5, 0.5]] * 32)
    plain = heavy(some)
    silent = np.zeros((500, 2))
    silent[:, 1] = 0.0009
    assert heavy(np.vstack([some, silent])) == plain
    # One of the two is enough.
    assert heavy(np.vstack([some, [[0.0, 0.5]] * 10])) != plain
    unused = np.vstack([some, [[9.0, 9.0]]])
    assert heavy(unused, [True] * 41 + [False]) == plain
    assert heavy(silent) == heavy(some, [False] * 41) == Thresholds(4.0, 0.002, 20.0)
