"""What the last fits of the stages free, how surely it was known before, and which of them is told."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag

from disco_hw.gap import search as stages
from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.search import _chain, _Fitted, _information, _on_top, _roughly, _split, _timed, joint_predictions
from disco_hw.gap.search.analysis import final_fit
from disco_hw.gap.search.cross_validation import Chain
from disco_hw.gap.search.end_to_end import Ahead, Freed, JointFit, Part
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.search.richest_model import DELAY_STARTS_S
from disco_hw.gap.settings import DEFAULT_SETTINGS, Folds
from tests.gap.search.test_stages import LAG, SLIP, analysed
from tests.gap.synthetic import errors_of_size

DELAY = WHEEL.place["command_delay.delay_s"]


def fit_of(slope, residual=None, active=None, precision=None, vector=None):
    active = tuple(range(slope.shape[1])) if active is None else active
    residual = np.zeros(slope.shape[0]) if residual is None else residual
    return Fit(vector, active, 0.0, residual, slope, precision)


def test_without_a_fold_is_known_what_the_stretches_of_the_others_say_and_what_was_expected():
    rng = np.random.default_rng(0)
    slope, block = rng.standard_normal((900, 3)), np.arange(900) // 10
    # Four blocks of 3 s are a stretch of 12 s, and every third one is of one fold.
    drive = SimpleNamespace(folds=Folds(12.0, 3), settings=DEFAULT_SETTINGS, log_begins_s=(0.0,))
    drive.stretch = partial(GriddedDrive.stretch, drive)
    channel = SimpleNamespace(settings=DEFAULT_SETTINGS, block=block, drive=drive)
    for fold in range(3):
        others = slope[(block // 4) % 3 != fold]
        np.testing.assert_allclose(_information(fit_of(slope), channel, fold), others.T @ others)
        expected = _information(fit_of(slope, precision=np.array([1.0, 2.0, 3.0])), channel, fold)
        np.testing.assert_allclose(expected, others.T @ others + np.diag([1.0, 2.0, 3.0]))


def test_the_geometry_is_about_what_the_body_has_it_to_be_and_of_the_rest_nothing_is_known():
    vector = np.array([0.06, 0.4, 0.1, 7.0, 9.0])
    body = SimpleNamespace(settings=DEFAULT_SETTINGS, free=(0, 1, 2))
    known = _roughly(body, fit_of(np.zeros((1, 4)), active=(0, 1, 2, 4), vector=vector))
    # A tenth of each, and of the axial distance for x_icr.
    np.testing.assert_allclose(known, np.diag([0.006**-2.0, 0.04**-2.0, 0.04**-2.0, 0.0]))
    wheels = SimpleNamespace(settings=DEFAULT_SETTINGS, free=())
    assert (_roughly(wheels, fit_of(np.zeros((1, 2)), active=(3, 4), vector=vector)) == np.zeros((2, 2))).all()


def known(size, seed):
    root = np.random.default_rng(seed).standard_normal((size, size))
    return root @ root.T + size * np.eye(size)


def test_on_top_of_the_timed_stage_stands_what_else_was_found_as_surely_as_by_itself():
    body, wheels = BODY.neutral.copy(), WHEEL.neutral.copy()
    own_body, own_wheels = body.copy(), wheels.copy()
    own_body[[0, 1, 2, SLIP]] = 0.07, 0.5, 0.2, 0.08
    own_wheels[[LAG, 13]] = 0.3, 0.1
    body[:3] = 0.06, 0.4, 0.1
    wheels[[LAG, DELAY]] = 0.2, 0.05
    raised = WHEEL.low.copy()
    raised[[LAG, DELAY, 13]] = 0.01, 0.02, 0.03
    amended = Freed(
        (Part(BODY, own_body, (0, 1, 2, SLIP), known(4, 0)), Part(WHEEL, own_wheels, (LAG, 13), known(2, 1))),
        lambda vectors: Chain(*vectors),
    )
    timed = Freed(
        (Part(BODY, body, (0, 1, 2), known(3, 2)), Part(replace(WHEEL, low=raised), wheels, (LAG, DELAY), known(2, 3))),
        lambda vectors: Chain(*vectors),
    )
    both = _on_top(amended, timed, True)
    assert both.chain is amended.chain
    first, second = both.parts
    assert first.active == (0, 1, 2, SLIP)
    np.testing.assert_array_equal(first.vector[[0, 1, 2, SLIP]], [0.06, 0.4, 0.1, 0.08])
    # What is known of an entry alone, whatever the others: the inverse of its variance.
    alone = 1.0 / np.linalg.inv(known(4, 0))[3, 3]
    np.testing.assert_allclose(first.information, block_diag(known(3, 2), [[alone]]))
    assert second.active == (LAG, DELAY, 13)
    np.testing.assert_array_equal(second.vector[[LAG, DELAY, 13]], [0.2, 0.05, 0.1])
    np.testing.assert_allclose(second.information, block_diag(known(2, 3), [[1.0 / np.linalg.inv(known(2, 1))[1, 1]]]))
    # A lag may not become less than the timed stage lets it.
    np.testing.assert_array_equal(second.layout.low[[LAG, DELAY, 13]], [0.01, 0.02, WHEEL.low[13]])
    same = _on_top(replace(amended, parts=(replace(amended.parts[0], active=(0, 1, 2), information=known(3, 5)),)),
                   replace(timed, parts=timed.parts[:1]), True)  # fmt: skip
    np.testing.assert_array_equal(same.parts[0].information, known(3, 2))
    # From where the channels have it all else is alike; a delay of none is less than the timed stage lets it be.
    own = _on_top(amended, timed, False)
    for part, begun, vector in zip(both.parts, own.parts, (own_body, own_wheels), strict=True):
        assert begun.active == part.active
        np.testing.assert_array_equal(begun.information, part.information)
        np.testing.assert_array_equal(begun.layout.low, part.layout.low)
        expected = vector.copy()
        if part is both.parts[1]:
            expected[DELAY] = 0.02
        np.testing.assert_array_equal(begun.vector, expected)


@pytest.mark.parametrize(
    ("lag_s", "delay_s", "begins"), [(0.49, 0.19, 1), (0.51, 0.0, 2), (0.09, 0.0, 2), (0.3, 0.21, 2), (0.3, 0.2, 1)]
)
def test_a_fit_begins_also_where_the_channel_has_it_if_the_timed_stage_is_far_off(lag_s, delay_s, begins):
    def of(lag_s, delay_s):
        wheels = WHEEL.neutral.copy()
        wheels[[LAG, DELAY]] = lag_s, delay_s
        parts = Part(BODY, BODY.neutral, (0, 1, 2), np.eye(3)), Part(WHEEL, wheels, (LAG, DELAY), np.eye(2))
        return Freed(parts, lambda vectors: Chain(*vectors))

    analysis = SimpleNamespace(drive=SimpleNamespace(settings=DEFAULT_SETTINGS))
    own = of(0.3, 0.0)
    timed = SimpleNamespace(at=lambda held=None: of(lag_s, delay_s))
    found = stages._Candidate(analysis, None, own, {0: own, 1: own}).on_top(timed)
    assert [one.of.parts[1].vector[LAG] for one in found] == [lag_s, 0.3][:begins]
    assert [one.by_fold[1].parts[1].vector[LAG] for one in found] == [lag_s, 0.3][:begins]
    # Without commands wheels are late by nothing.
    alone = SimpleNamespace(at=lambda held=None: replace(of(lag_s, delay_s), parts=of(0.0, 0.0).parts[:1]))
    bare = replace(own, parts=own.parts[:1])
    assert len(stages._Candidate(analysis, None, bare, {0: bare, 1: bare}).on_top(alone)) == 1


class Noted:
    """Stands for the fit of the whole chain: it moves each freed entry by `by`; `asked` for so far."""

    folds = 2

    def __init__(self, by=0.0, costs=()):
        self.by, self.asked, self.costs, self.costed = by, [], list(costs), []

    def fit(self, of, left_out=None, begin=None):
        self.asked.append((of, left_out))
        at = of if begin is None else of.at(begin)
        moved = of.vectors(at.joined(lambda part: part.vector) + self.by * (1 if left_out is None else 2 + left_out))
        return JointFit(tuple(moved), 0.0, of.names, np.eye(len(of.names)))

    def usual_cost(self, chain, left_out=None):
        self.costed.append(chain)
        return self.costs[len(self.costed) - 1]


def two_parts(active=()):
    return Freed(
        (Part(BODY, BODY.neutral, (0, 1, 2), known(3, 0)), Part(WHEEL, WHEEL.neutral, active, known(len(active), 1))),
        lambda vectors: Chain(*vectors),
    )


@pytest.mark.parametrize("best", range(len(DELAY_STARTS_S)))
def test_lateness_is_freed_from_every_start_and_kept_from_the_best(best):
    ahead = Noted(0.001, [0.0 if k == best else 1.0 + k for k in range(len(DELAY_STARTS_S))])
    found = _timed(ahead, two_parts((13,)))
    for (of, left_out), start in zip(ahead.asked, DELAY_STARTS_S, strict=True):
        assert left_out is None
        body, wheels = of.parts
        assert body.active == (0, 1, 2)
        assert wheels.active == (13, LAG, DELAY)
        assert tuple(wheels.vector[[LAG, DELAY]]) == start
        np.testing.assert_array_equal(wheels.information, block_diag(known(1, 1), np.zeros((2, 2))))
        # Real wheels are never ahead of their command, though a wrong clock may let them seem so.
        assert (wheels.layout.low[[LAG, DELAY]] == 0.0).all()
        assert wheels.layout.low[13] == WHEEL.low[13]
    assert tuple(found.parts[1].vector[[LAG, DELAY]]) == pytest.approx(tuple(x + 0.001 for x in DELAY_STARTS_S[best]))
    assert found.parts[1].vector is ahead.costed[best].wheels


def test_lateness_that_is_free_already_is_freed_once_and_without_wheels_none():
    ahead = Noted(costs=[1.0] * len(DELAY_STARTS_S))
    assert _timed(ahead, two_parts((LAG,))).parts[1].active == (LAG, DELAY)
    alone = replace(two_parts(), parts=two_parts().parts[:1])
    assert _timed(ahead, alone) is alone


def test_folds_are_fitted_from_the_fit_of_all():
    ahead = Noted(0.001)
    of = two_parts((LAG,))
    fitted = _Fitted.to(ahead, of)
    assert [left_out for _, left_out in ahead.asked] == [None, 0, 1]
    assert ahead.asked[1][0].parts[1].vector[LAG] == pytest.approx(0.001)
    # Around the fit of all data, and around those without a fold.
    assert [fitted.at(held).parts[1].vector[LAG] for held in (None, 0, 1)] == pytest.approx([0.001, 0.003, 0.004])
    assert [fitted.chains[held].wheels[LAG] for held in (0, 1)] == pytest.approx([0.003, 0.004])


@pytest.mark.parametrize("best", range(3))
def test_the_fit_of_all_data_begins_from_those_of_the_folds_too_and_the_best_is_kept(best):
    of = two_parts((LAG,))
    lags = [0.001, 0.201, 0.401]
    folds = {held: JointFit((BODY.neutral, WHEEL.neutral + 0.2 * (1 + held)), 0.0, (), np.eye(0)) for held in (0, 1)}
    ahead = Noted(0.001, [0.0 if k == best else 1.0 + k for k in range(3)])
    found = stages._Evaluated(SimpleNamespace(of=of), ahead.fit(of), folds, None).fit(ahead)
    assert [chain.wheels[LAG] for chain in ahead.costed] == pytest.approx(lags)
    assert [left_out for _, left_out in ahead.asked] == [None] * 3
    assert found.vectors[1][LAG] == pytest.approx(lags[best])


@pytest.mark.parametrize(("gains", "begins_again"), [(0.11, True), (0.09, False)])
def test_a_fit_without_a_fold_begins_where_the_whole_fit_ended_only_if_its_own_end_is_far_above(gains, begins_again):
    of, whole = two_parts((LAG,)), two_parts((LAG,)).at((BODY.neutral, WHEEL.neutral + 0.2))
    settings = SimpleNamespace(report=SimpleNamespace(worth_share=0.1))
    candidate = stages._Candidate(SimpleNamespace(drive=SimpleNamespace(settings=settings)), None, whole, {1: of})
    ahead = Noted(0.001, [gains, 0.0])
    joint = ahead.fit(whole)
    found = candidate._fit_without(1, joint, ahead)
    assert [chain.wheels[LAG] for chain in ahead.costed] == pytest.approx([0.003, 0.201])
    assert found.vectors[1][LAG] == pytest.approx(0.204 if begins_again else 0.003)


@pytest.fixture
def unfitted(monkeypatch):
    """Has every fit of the whole chain stay where it begins; what was asked for."""
    asked = []

    def fit(self, of, left_out=None, begin=None):
        asked.append((of, left_out))
        return Noted().fit(of, left_out, begin)

    monkeypatch.setattr(Ahead, "fit", fit)
    return asked


def errors_in_turn(monkeypatch, *sizes):
    """Has the amended options err by these positions and headings, in their order; those with less by far more."""
    left = list(sizes)

    def errors(body, wheels, chains, ahead_s, poses):
        return errors_of_size(*(left.pop(0) if left else (9.0, 9.0)))

    monkeypatch.setattr(stages, "errors_of", errors)


@pytest.mark.parametrize(
    ("apart", "on_top", "told_on_top"),
    [
        ((0.1, 0.4), (0.3, 0.1), True),
        ((0.1, 0.2), (0.3, 0.1), False),
        # By more than a tenth, which a change is worth, and by less.
        ((0.2, 0.2), (0.2, 0.175), True),
        ((0.2, 0.2), (0.2, 0.19), False),
    ],
)
def test_of_the_amended_stage_the_way_is_told_that_predicts_better(unfitted, monkeypatch, apart, on_top, told_on_top):
    errors_in_turn(monkeypatch, apart, on_top)
    analysis = analysed()
    predictions = joint_predictions(analysis, final_fit(analysis))
    assert ("command_delay.delay_s" in predictions.joint["amended"][1].names) is told_on_top


def test_what_channels_say_is_trusted_to_three_of_their_deviations_and_folds_by_what_the_others_say(
    unfitted, monkeypatch
):
    errors_in_turn(monkeypatch, (0.1, 0.1), (0.2, 0.2))
    analysis = analysed()
    joint_predictions(analysis, final_fit(analysis))
    body, wheels = analysis.body.reported, analysis.wheels.reported
    refitted = [of for of, left_out in unfitted if of.names == ("wheel_radius_m", "axial_distance_m", "x_icr_m")]
    np.testing.assert_allclose(
        refitted[0].parts[0].information, _roughly(analysis.body.channel, analysis.body.base), rtol=1e-9
    )
    names = ("wheel_radius_m", "axial_distance_m", "x_icr_m", "turn_slip.k_s", "motor_lag.tau_s")
    asked = [(of, left_out) for of, left_out in unfitted if of.names == names]
    whole, *again = (of for of, left_out in asked if left_out is None)
    # Once from where it begins, and from where each fold ended, about the same.
    assert [of is whole for of in again] == [True] * analysis.drive.folds.count
    folds = [(of, left_out) for of, left_out in asked if left_out is not None]
    for part, fitted in zip(whole.parts, (body, wheels), strict=True):
        np.testing.assert_allclose(part.information, fitted.information() / 9.0)
        np.testing.assert_array_equal(part.vector, fitted.vector)
    assert [left_out for _, left_out in folds] == list(range(analysis.drive.folds.count))
    for of, held in folds:
        for part, fitted, found in zip(of.parts, (body, wheels), (analysis.body, analysis.wheels), strict=True):
            expected = _information(fitted, found.channel, held) / 9.0
            np.testing.assert_allclose(part.information, expected)
            assert (part.vector != fitted.vector).any()


def test_without_anything_found_nothing_is_put_on_top(unfitted):
    analysis = analysed((), ())
    predictions = joint_predictions(analysis, final_fit(analysis))
    assert predictions.joint["amended"][1].names == ("wheel_radius_m", "axial_distance_m", "x_icr_m")
    refitted = predictions.joint["refitted"][0].chain
    assert refitted(["body", "wheels"]) == Chain("body", "wheels")
    assert refitted(["body"]) == Chain("body", None)


def test_a_vector_without_terms_is_whole_and_of_one_with_terms_what_they_add_is_told():
    channel = SimpleNamespace(split=lambda vector: (vector[:3], vector[3:] * 10.0))
    found = SimpleNamespace(
        channel=SimpleNamespace(layout=SimpleNamespace(columns=("a", "b", "c"))),
        selector=SimpleNamespace(channel=channel),
    )
    plain = np.array([1.0, 2.0, 3.0])
    core, added = _split(found, plain)
    assert core is plain
    assert added is None
    core, added = _split(found, np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert (core.tolist(), added.tolist()) == ([1.0, 2.0, 3.0], [40.0, 50.0])


def test_where_encoders_count_wrong_the_wheels_of_the_chain_have_no_gain():
    analysis = analysed()
    gains = [WHEEL.place[f"wheel_gain.{side}"] for side in ("left", "right")]
    wheels = WHEEL.neutral.copy()
    wheels[gains] = 0.1, 0.2
    vectors = [BODY.neutral, wheels]
    for cause, expected in ((False, (0.1, 0.2)), (True, (0.0, 0.0))):
        chain = _chain(analysis, SimpleNamespace(encoder_is_cause=cause), vectors)
        assert tuple(chain.wheels[gains]) == expected
        assert chain.body is vectors[0]
        assert chain.body_perturbation is chain.wheels_perturbation is None
    assert tuple(wheels[gains]) == (0.1, 0.2)
