"""Terms that remember or vary with time: found, told, and written into the model where one can carry them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from disco_hw.gap import find_gap
from disco_hw.gap.search import channel_search
from disco_hw.gap.search.channel_search import best_terms, with_unnamed
from disco_hw.gap.search.least_squares import fit
from disco_hw.gap.search.unnamed_terms import Term, WithTerms, motion
from disco_hw.model import Model, load_model, save_model
from tests.gap.search.another_drive import another_drive, errors_ahead, without_terms
from tests.gap.synthetic import body_channel, moved_by, searched
from tools.gap import strange_robot


@cache
def turning_less():
    """A channel whose robot turns less the faster it turns, its plain fit, and the yaw rate at the nodes."""
    channel, line = body_channel(turn_slip=0.1)
    return searched(channel), motion(line, channel.neutral)[1]


def on_turning(form, feature, **kinds):
    return Term(form, np.column_stack([np.zeros((feature.size, 2)), feature]), **kinds)


def test_features_that_belong_together_have_a_coefficient_each_and_pay_for_each():
    found, rate = turning_less()
    half = np.where(np.arange(rate.size) < rate.size // 2, 1.0, 0.0)
    both = on_turning("{:.3g}", rate * half)
    both = replace(both, further_waves=(on_turning("", rate * (1.0 - half)).perturbation,), usual=0.1)
    channel = WithTerms.of(found.channel, (both, on_turning("{}", rate**3)))
    width = len(found.channel.layout.columns)
    assert channel.layout.columns[width:] == ("term0", "term0.1", "term1")
    assert channel.neutral.size - channel.inner.neutral.size == 3
    assert channel.layout.precision[width:] == pytest.approx([100.0, 100.0, 0.0])
    _, added = channel.split(np.concatenate([found.channel.neutral, [0.2, -0.1, 0.0]]))
    np.testing.assert_allclose(added[:, 2], rate * (0.2 * half - 0.1 * (1.0 - half)))
    assert both.written(np.array([0.3, -0.4])) == f"{0.5 / 2**0.5:.3g}"


def test_tyres_that_slip_are_told_by_what_they_grip():
    """A robot whose speed follows its wheels by at most 0.02 m/s in a hundredth of a second, where they jump."""
    channel, line = body_channel()
    rolling = 0.5 * channel.neutral[0] * line.speed_rad_s.sum(axis=1)
    speed, lost = 0.0, np.zeros((rolling.size, 3))
    for k, wheels in enumerate(rolling):
        before, speed = speed, min(max(wheels, speed - 0.02), speed + 0.02)
        lost[k, 0] = 0.5 * (before + speed) - wheels
    (term, *_) = with_unnamed(searched(moved_by(channel, lost)), channel_search._body_options).unnamed
    assert term.term.model_name == "v_x += k (v - slewed_2(v))"
    assert float(term.form.split()[2]) == pytest.approx(-1.0, abs=0.1)


def test_a_term_whose_number_cannot_be_so_large_is_not_offered_and_not_fitted_beyond():
    found, rate = turning_less()
    # It turns less the faster it turns: the number is below zero.
    for sign, highest, offered in ((1.0, 0.0, True), (-1.0, 0.0, False), (-1.0, np.inf, True)):
        term = on_turning("{:.3g}", sign * rate * np.abs(rate), highest=highest)
        promising, _ = best_terms(found.fit, found.channel, iter([term]))
        assert bool(promising) == offered
        # Nor beside another one.
        beside = WithTerms.of(found.channel, (on_turning("{:.3g}", 0.1 * np.sin(0.6 * np.arange(rate.size))),))
        with_other = fit(beside, np.append(found.fit.vector, 0.0), beside.free)
        promising, _ = best_terms(with_other, beside, iter([term]))
        assert bool(promising) == offered
        channel = WithTerms.of(found.channel, (term,))
        assert channel.layout.high[-1] == highest
    options = channel_search._body_options(found)
    most = {term.highest for term in options if term.model_name is not None and "slewed" in term.model_name}
    assert most == {0.0}


@pytest.mark.long
@pytest.mark.parametrize(
    ("form", "seed", "term"),
    [
        ("hysteresis", 601, "command += k sign(u - mean_1s(u))"),
        ("cross_coupled_supply", 501, "command += k u mean_1s(|u| + |u_other|)"),
        ("tyre_relaxation", 601, "omega += k (omega - mean_1s(omega))"),
    ],
)
def test_what_a_robot_remembers_is_in_its_model_and_predicts_another_drive(form, seed, term, tmp_path):
    report = find_gap(strange_robot.record(form, seed).log, Model(*strange_robot.NOMINAL))
    assert {effect.name for effect in report.effects} <= {"motor_lag", "command_delay"}
    assert all(found.in_model for found in report.unnamed)
    assert "written" not in report.gap
    save_model(report.model, tmp_path / "model.toml")
    model = load_model(tmp_path / "model.toml")
    assert term in [setting.name for setting in model.effects]
    other = another_drive(form, seed)
    with_it, without, forgetting = (
        np.array(errors_ahead(one, other, remembers))
        for one, remembers in ((model, True), (without_terms(model), True), (model, False))
    )
    assert (with_it < 0.7 * without).all(), (with_it, without)
    assert (with_it < 0.7 * forgetting).all(), (with_it, forgetting)


@pytest.mark.long
def test_wheels_whose_controller_overshoots_are_told_and_predicted():
    """The controller swings, which the term does not: of that a term is told that no model holds."""
    report = find_gap(strange_robot.record("speed_loop", 601).log, Model(*strange_robot.NOMINAL))
    assert {effect.name for effect in report.effects} <= {"motor_lag", "command_delay"}
    told = [found for found in report.unnamed if found.in_model]
    assert str(told[0].meaning).startswith("the wheels overshoot a change of their command")
    assert "command += k (u - mean_0.3s(u))" in [setting.name for setting in report.model.effects]
    other = another_drive("speed_loop", 601)
    with_it, without = (np.array(errors_ahead(one, other)) for one in (report.model, without_terms(report.model)))
    assert (with_it < 0.7 * without).all(), (with_it, without)


@pytest.mark.long
def test_ground_that_carries_more_and_less_in_turn_is_neither_a_change_nor_a_patch():
    report = find_gap(strange_robot.record("time_varying_friction", 503).log, Model(*strange_robot.NOMINAL))
    assert {effect.name for effect in report.effects} <= {"motor_lag", "command_delay"}
    assert "varies slowly with time" in report.unnamed[0].form
