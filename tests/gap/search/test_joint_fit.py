"""The last fit of the chain on errors that are linear in what is freed: against a plain minimiser of the same cost."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize

from disco_hw.gap.data import BASE_COUNT, BODY, WHEEL
from disco_hw.gap.search import end_to_end
from disco_hw.gap.search.cross_validation import Chain
from disco_hw.gap.search.end_to_end import Ahead, Freed, JointFit, Part, _usual
from disco_hw.gap.settings import DEFAULT_SETTINGS, Folds
from tests.gap.synthetic import GEOMETRY, vector_of

MANY = 80
HORIZONS_S = (1.0, 2.0)
IN_TWO = SimpleNamespace(folds=Folds(21.0, 2))


def of_geometry(information):
    """The geometry of a chain without wheels, freed, of which so much is known."""
    return Freed((Part(BODY, vector_of(), (0, 1, 2), information),), lambda vectors: Chain(vectors[0], None))


@pytest.fixture
def linear(monkeypatch):
    """Predictions whose errors are linear in the geometry, with some that are far off; slopes and errors at 0."""
    rng = np.random.default_rng(4)
    slopes = [rng.standard_normal((MANY, 3, 3)) * (1.0, 0.3, 0.5) for _ in HORIZONS_S]
    truth = np.add(GEOMETRY, (0.01, -0.04, 0.03))
    noise = [rng.standard_normal((MANY, 3)) * (0.004, 0.004, 0.02) for _ in HORIZONS_S]
    for of in noise:
        of[::9] *= 12.0

    def errors(self, chain, turned=None):
        return [a @ (chain.body[:3] - truth) + e for a, e in zip(slopes, noise, strict=True)]

    monkeypatch.setattr(Ahead, "errors", errors)
    monkeypatch.setattr(end_to_end, "chain_wheels", lambda *_: None)
    body = SimpleNamespace(settings=DEFAULT_SETTINGS, drive=IN_TWO)
    starts = tuple((ahead_s, SimpleNamespace(block=np.arange(MANY) // 10)) for ahead_s in HORIZONS_S)
    return Ahead(body, None, starts), lambda values: [
        a @ (values - truth) + e for a, e in zip(slopes, noise, strict=True)
    ]


def minimised(errors, chosen, information, begin, horizons_s=HORIZONS_S):
    """The same by its definition: two rounds, each in units of what is usual where it begins."""
    values = begin.copy()
    shares = [min(np.sqrt(0.2 / ahead_s), 1.0) for ahead_s in horizons_s]
    huber = 3.0 * max(shares)
    for _ in range(2):
        units = []
        for error, share in zip(errors(values), shares, strict=True):
            position = 1.4826 * np.median(np.abs(error[chosen][:, :2]))
            heading = 1.4826 * np.median(np.abs(error[chosen][:, 2]))
            units.append(np.array([position, position, heading]) / share)

        def cost(at, units=units):
            parts = [(e[chosen] / unit).ravel() for e, unit in zip(errors(at), units, strict=True)]
            z = np.abs(np.concatenate([*parts, np.linalg.cholesky(information).T @ (at - begin)]))
            return float(np.where(z <= huber, 0.5 * z**2, huber * (z - 0.5 * huber)).sum())

        values = minimize(cost, values, method="BFGS", options={"gtol": 1e-9}).x
    return values, cost(values)


@pytest.mark.parametrize("left_out", [None, 0, 1])
@pytest.mark.parametrize("known", [1e-3, 3e3])
def test_what_predicts_best_is_found_by_errors_in_their_usual_size_and_what_was_known_before(linear, left_out, known):
    ahead, errors = linear
    information = known * np.diag([1.0, 2.0, 0.5])
    found = ahead.fit(of_geometry(information), left_out)
    chosen = (np.arange(MANY) // 10) % 2 != left_out
    values, cost = minimised(errors, chosen, information, np.array(GEOMETRY))
    assert found.vectors[0][:3] == pytest.approx(values, abs=2e-5)
    assert np.abs(values - GEOMETRY).max() > 0.002
    assert found.cost == pytest.approx(cost, rel=1e-3)
    assert (found.vectors[0][3:] == BODY.neutral[3:]).all()


def test_a_fit_begins_where_it_is_told_and_trusts_what_it_is_about(linear):
    ahead, _ = linear
    steps = replace(DEFAULT_SETTINGS, fit=replace(DEFAULT_SETTINGS.fit, rounds=0))
    still = replace(ahead, body=SimpleNamespace(settings=steps, drive=IN_TWO))
    of, off = of_geometry(3e6 * np.eye(3)), vector_of() + np.where(np.arange(BODY.neutral.size) < 3, 0.01, 0.0)
    assert still.fit(of, begin=[off]).vectors[0][:3] == pytest.approx(off[:3], abs=1e-6)
    assert still.fit(of).vectors[0][:3] == pytest.approx(GEOMETRY, abs=1e-6)
    # From there it finds what it finds from its own start.
    assert ahead.fit(of, begin=[off]).vectors[0] == pytest.approx(ahead.fit(of).vectors[0], abs=1e-4)


def test_predictions_that_do_not_overlap_count_whole(linear):
    ahead, errors = linear
    horizons_s = (0.1, 1.0)
    ahead = replace(ahead, starts=tuple(zip(horizons_s, (starts for _, starts in ahead.starts), strict=True)))
    values, cost = minimised(errors, np.full(MANY, True), np.eye(3), np.array(GEOMETRY), horizons_s)
    found = ahead.fit(of_geometry(np.eye(3)))
    assert found.vectors[0][:3] == pytest.approx(values, abs=2e-5)
    assert found.cost == pytest.approx(cost, rel=1e-3)


def test_wheels_are_run_anew_for_what_moves_them_and_not_for_effects_of_the_body(monkeypatch):
    asked, turned_once = [], object()

    def errors(self, chain, turned=None):
        values = np.array([chain.body[2], chain.body[BASE_COUNT], chain.wheels[5]])
        asked.append((values, turned))
        return [np.full((4, 3), 0.1) + values.sum()]

    monkeypatch.setattr(Ahead, "errors", errors)
    monkeypatch.setattr(end_to_end, "chain_wheels", lambda *_: turned_once)
    once = replace(DEFAULT_SETTINGS.fit, rounds=1, iterations=1)
    body = SimpleNamespace(settings=replace(DEFAULT_SETTINGS, fit=once), drive=IN_TWO)
    vector = vector_of()
    vector[2] = BODY.high[2]
    parts = (Part(BODY, vector, (2, BASE_COUNT), np.eye(2)), Part(WHEEL, WHEEL.neutral, (5,), np.eye(1)))
    Ahead(body, None, ((1.0, SimpleNamespace(block=np.zeros(4, dtype=int))),)).fit(
        Freed(parts, lambda vectors: Chain(*vectors))
    )
    # Derivatives: at the start with the wheels as they turn there, then by one entry after the other.
    base = next(place for place, (_, turned) in enumerate(asked) if turned is turned_once)
    moved = asked[base + 1 : base + 4]
    np.testing.assert_array_equal(np.array([values for values, _ in moved]) != asked[base][0], np.eye(3, dtype=bool))
    assert [turned for _, turned in moved] == [None, turned_once, None]
    # By a step up, or down where there is no room.
    steps = [BODY.step[2], BODY.step[BASE_COUNT], WHEEL.step[5]]
    changes = [values[k] - asked[base][0][k] for k, (values, _) in enumerate(moved)]
    assert changes == pytest.approx(np.array([-1.0, 1.0, 1.0]) * steps, rel=1e-6)


def test_what_nothing_is_known_of_hardly_stays_and_a_fit_begins_inside_its_bounds():
    ahead = Ahead(SimpleNamespace(settings=DEFAULT_SETTINGS, drive=IN_TWO), None, ())
    vector, active = vector_of(), (0, 1, int(np.argmax(BODY.step)))
    step = BODY.step[list(active)]
    assert step[2] > 5.0 * step[0]
    wide = replace(BODY, high=np.full(BODY.high.size, 1e6))

    def fitted(layout):
        vector[0], vector[1] = layout.low[0], layout.high[1]
        of = Freed((Part(layout, vector, active, np.zeros((3, 3))),), lambda vectors: Chain(vectors[0], None))
        return ahead.fit(of)

    # To ten thousand of the steps by which derivatives are taken, or to anywhere in the range.
    assert np.sqrt(np.diag(fitted(wide).covariance)) == pytest.approx(1e4 * step, rel=1e-6)
    found, reach = fitted(BODY), (BODY.high - BODY.low)[list(active)]
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(np.minimum(1e4 * step, reach / 12.0**0.5), rel=1e-6)
    inside = np.array([found.vectors[0][0] - BODY.low[0], BODY.high[1] - found.vectors[0][1]])
    assert (inside > 0.0).all()
    assert (inside < 1e-3 * step[:2]).all()


def test_without_predictions_everything_stays_as_surely_as_it_was_known():
    ahead = Ahead(SimpleNamespace(settings=DEFAULT_SETTINGS, drive=IN_TWO), None, ())
    information = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.5], [0.0, 0.5, 2.0]]) * 1e4
    found = ahead.fit(of_geometry(information))
    assert found.vectors[0] == pytest.approx(vector_of())
    assert found.cost == np.inf
    assert found.covariance == pytest.approx(np.linalg.inv(information), rel=1e-3)


def test_what_is_usual_is_the_median_of_positions_and_of_headings():
    error = np.array([[1.0, -3.0, 0.1], [2.0, 5.0, -0.4], [-4.0, 90.0, 0.2]])
    assert _usual(error) == pytest.approx(1.4826 * np.array([3.5, 3.5, 0.2]))
    assert _usual(np.zeros((3, 3))) == pytest.approx(np.full(3, 1e-5))
    # A fold may hold all that is predicted so far ahead: then nothing is known, and nothing asked.
    assert _usual(np.zeros((0, 3))).tolist() == [1.0] * 3


def test_chains_are_compared_by_the_logarithms_of_both_usual_errors(linear):
    ahead, errors = linear
    # Of two folds of ten predictions in turn all, and those outside the second one.
    for left_out, chosen in ((None, np.arange(MANY) >= 0), (1, np.arange(MANY) // 10 % 2 == 0)):
        usual = [_usual(error[chosen]) for error in errors(np.array(GEOMETRY))]
        expected = sum(np.log(position) + np.log(heading) for _, position, heading in usual)
        assert ahead.usual_cost(Chain(vector_of(), None), left_out) == pytest.approx(expected)


def test_an_entry_is_told_of_its_own_part_or_of_the_first_that_has_it():
    parts = tuple(Part(BODY, vector_of(), (0,), np.eye(1)) for _ in range(2))
    of = Freed(parts, lambda vectors: Chain(vectors[0], None))
    vectors = (vector_of(), 2.0 * vector_of())
    joint = JointFit(vectors, 0.0, (), np.zeros((0, 0)))
    assert joint.value("axial_distance_m", of) == GEOMETRY[1]
    assert joint.value("axial_distance_m", of, parts[1]) == 2.0 * GEOMETRY[1]
    assert joint.value("nothing", of) is None
