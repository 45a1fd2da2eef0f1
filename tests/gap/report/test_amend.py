"""What an amended model holds of terms without a name: their numbers, and how far each of them reaches."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.report.amend import amended_model, carried_terms, with_terms_named
from disco_hw.gap.search.analysis import GapAnalysis
from disco_hw.gap.search.channel_result import ChannelEstimates, ParameterEstimate, UnnamedTerm
from disco_hw.gap.search.unnamed_terms import Term
from disco_hw.model import EffectSetting, Gaussian, Model

DRAG, TURN, SHARED = "v_x += k v^3", "omega += k v^2 omega", "command += k u_other"


def estimates(**values):
    """Of parameters that are known to a tenth of a unit."""
    by_name = {name: ParameterEstimate.around(value, 0.1) for name, value in values.items()}
    return (ChannelEstimates(by_name, tuple(by_name), 0.01 * np.eye(len(by_name))),)


def terms_of(model, terms, values):
    found, notes = amended_model(model, {}, terms, estimates(**values))
    assert not notes
    return {setting.name: dict(setting.values) for setting in found.effects}, found


def test_a_term_reaches_as_far_as_its_log_did():
    terms, found = terms_of(Model(0.06, 0.4), {DRAG: 0.2, SHARED: 7.0}, {f"{DRAG}.k": -0.5, f"{SHARED}.k": 0.1})
    assert terms == {DRAG: {"k": -0.5, "reach": 0.2}, SHARED: {"k": 0.1, "reach": 7.0}}
    # Nothing is believed of a reach: it is no property of the robot.
    assert found.belief.names == (f"{DRAG}.k", f"{SHARED}.k")


@pytest.mark.parametrize(("larger", "smaller"), [(0.3, 0.2), (0.2, 0.3)])
def test_a_term_that_a_model_has_reaches_no_less_far_after_another_log(larger, smaller):
    model = Model(0.06, 0.4, effects=(EffectSetting(DRAG, {"k": -0.5, "reach": larger}),))
    terms, _ = terms_of(model, {DRAG: smaller}, {f"{DRAG}.k": -0.1})
    assert terms[DRAG] == {"k": pytest.approx(-0.6), "reach": 0.3}


def test_the_reach_of_a_known_term_is_that_of_the_same_turns_on_other_wheels():
    model = Model(
        0.06, 0.4, effects=(EffectSetting(DRAG, {"k": -0.5, "reach": 0.2}), EffectSetting(SHARED, {"k": 0.1}))
    )
    terms, found = terms_of(model, {}, {"wheel_radius_m": 0.066})
    assert terms[DRAG] == {"k": pytest.approx(-0.5 / 1.1**3), "reach": pytest.approx(0.2 * 1.1**3)}
    assert terms[SHARED] == {"k": pytest.approx(0.1), "reach": 1e9}
    assert amended_model(found, {}, {}, estimates(wheel_radius_m=0.01))[0].effects[1].values["reach"] == 1e9


def test_how_far_a_term_reaches_is_its_largest_feature_in_speeds_of_the_last_fit():
    feature = np.array([[0.1, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.2, 0.0, 0.0]])
    drag = Term("v_x += {:.4g} v^3", feature, DRAG, geometry=(0.06, 0.4))
    shared = Term("command += {:.4g} u_other", np.array([[4.0, -5.0]]), SHARED)
    written = [UnnamedTerm(term.form, None, term) for term in (drag, replace(drag, model_name=None), shared)]
    body, wheels = SimpleNamespace(unnamed=written[:2]), SimpleNamespace(unnamed=written[2:])
    analysis = GapAnalysis(None, None, None, body, wheels)
    final = SimpleNamespace(final_body=SimpleNamespace(vector=np.array([0.066, 0.5, 0.0])))
    assert carried_terms(analysis, final) == {DRAG: pytest.approx(0.3 * 1.1**3), SHARED: 5.0}
    turning = UnnamedTerm("", None, replace(drag, model_name=TURN))
    analysis = replace(analysis, body=SimpleNamespace(unnamed=[turning]))
    # The larger wheels and the longer axle turn more slowly.
    assert carried_terms(analysis, final)[TURN] == pytest.approx(0.3 * 1.1**3 / (0.5 / 0.4))
    unfitted = carried_terms(analysis, SimpleNamespace(final_body=None))
    assert unfitted[TURN] == pytest.approx(0.3 / 0.06**3 * 0.4)
    alone = carried_terms(replace(analysis, body=None), SimpleNamespace(final_body=None))
    assert alone == {SHARED: 5.0}


def test_numbers_of_terms_are_those_of_speeds_of_the_last_fit_with_what_they_share_with_others():
    drag = UnnamedTerm("", None, Term("", np.ones((1, 3)), DRAG, geometry=(0.06, 0.4)))
    place = UnnamedTerm("", None, Term("", np.ones((1, 3))))
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.25], [0.5, 0.25, 16.0]])
    by_name = {
        name: ParameterEstimate(value, value - 0.2, value + 0.3) for name, value in (("term0", 8.0), ("term1", 3.0))
    }
    part = ChannelEstimates(
        by_name | {"x_icr_m": ParameterEstimate.around(0.1, 0.1)}, ("term0", "x_icr_m", "term1"), covariance
    )
    named = with_terms_named(part, (place, drag), (0.12, 0.4))
    assert named.fitted == ("term0", "x_icr_m", f"{DRAG}.k")
    assert named.by_name["term0"] == by_name["term0"]
    value = named.by_name[f"{DRAG}.k"]
    assert (value.value, value.low, value.high) == pytest.approx((3.0 / 8.0, 2.8 / 8.0, 3.3 / 8.0))
    assert named.covariance == pytest.approx(covariance * np.outer([1.0, 1.0, 0.125], [1.0, 1.0, 0.125]))
    assert with_terms_named(part, (), (0.12, 0.4)).fitted == part.fitted


def test_what_is_believed_of_a_known_term_is_believed_after_a_log_that_says_nothing_of_it():
    believed = Gaussian(("x_icr_m", f"{DRAG}.k"), np.array([0.0, -0.5]), np.diag([0.01, 0.04]))
    effects = (EffectSetting(DRAG, {"k": -0.5}), EffectSetting(SHARED, {"k": 0.1}))
    model = Model(0.06, 0.4, effects=effects, belief=believed)
    found, _ = amended_model(model, {}, {}, estimates(wheel_radius_m=0.12))
    spread = dict(zip(found.belief.names, np.sqrt(np.diag(found.belief.covariance())), strict=True))
    # Twice as large wheels make an eighth of the number, and of how far it may be off.
    assert spread[f"{DRAG}.k"] == pytest.approx(0.2 / 8.0)
    assert spread[f"{SHARED}.k"] == pytest.approx(0.0, abs=1e-6)
    more, _ = amended_model(model, {}, {DRAG: 1.0}, estimates(**{f"{DRAG}.k": 0.3}))
    assert more.effects[0].values["k"] == pytest.approx(-0.2)
    spread = dict(zip(more.belief.names, np.sqrt(np.diag(more.belief.covariance())), strict=True))
    assert spread[f"{DRAG}.k"] == pytest.approx(0.1)


@pytest.mark.parametrize("name", ["motor_lag.tau_s", "command_delay.delay_s", "pose_latency.latency_s"])
@pytest.mark.parametrize(("time_s", "written"), [(7.5e-14, False), (0.0009, False), (0.0011, True)])
def test_a_time_below_a_millisecond_is_none(name, time_s, written):
    effect, _, key = name.partition(".")
    parts = estimates(**{name: time_s, "wheel_radius_m": 0.061})
    found, notes = amended_model(Model(0.06, 0.4), {effect: {key: parts[0].by_name[name]}}, {}, parts)
    assert [setting.name for setting in found.effects] == [effect] * written
    assert found.belief.names == (("wheel_radius_m", name) if written else ("wheel_radius_m",))
    assert not notes
