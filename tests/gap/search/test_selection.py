"""The selection names what was put into a small drive, whatever it began with, and nothing where there is nothing."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.search.evidence import EffectEvidence
from disco_hw.gap.search.richest_model import DELAY_NAMES, candidates_of
from disco_hw.gap.search.selection import Selector, Thresholds, body_moves
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from tests.gap.synthetic import (
    DRIVE,
    GEOMETRY,
    LIMITS,
    body_channel,
    fit_at,
    is_accepted,
    line_of,
    moved_by,
    selector_of,
    vector_of,
    wheels_on,
)


def selector(given=(), start=None, moves_m=0.001, **effects):
    channel, _ = body_channel(drive=DRIVE * 2, **effects)
    return selector_of(channel, replace(LIMITS, moves_m=moves_m), given=given, start=start)


def test_exactly_what_is_missing_is_selected():
    assert selector().select() == ()
    found = selector(turn_slip=0.08, wheel_radius_asymmetry=0.02)
    names = found.select()
    assert set(names) == {"turn_slip", "wheel_radius_asymmetry"}
    vector = found.fit(names).vector
    assert vector[BODY.place["turn_slip.k_s"]] == pytest.approx(0.08, rel=0.1)
    assert vector[BODY.place["wheel_radius_asymmetry.ratio"]] == pytest.approx(0.02, rel=0.1)


def test_what_is_not_needed_goes_again_and_a_stand_in_is_swapped_for_what_it_stood_in_for():
    found = selector(turn_slip=0.08)
    assert found.select(("side_slip", "turn_slip", "slope")) == ("turn_slip",)
    assert found.swapped(("surface_change",)) == ("turn_slip",)
    # Among some only those.
    assert found.needed(("side_slip", "turn_slip", "slope"), ("slope", "turn_slip")) == ("side_slip", "turn_slip")
    assert found.swapped(("surface_change",), ("slope", "turn_slip")) == ("surface_change",)
    assert found.swapped(("surface_change",), ("surface_change", "slope")) == ("surface_change",)
    assert found.swapped(("surface_change",), ("surface_change", "slope", "turn_slip")) == ("turn_slip",)


def wheels_that_follow(commands, followed, moves_m=0.001):
    """A search of wheels of which both were commanded alike (M,) and turned alike."""
    both, turned = (np.repeat(each[:, None], 2, axis=1) for each in (commands, followed))
    return selector_of(wheels_on(replace(line_of(turned), command_rad_s=both)), replace(LIMITS, moves_m=moves_m))


def test_a_short_lag_with_a_delay_beside_it_is_not_taken_for_the_delay():
    commands = np.repeat(np.random.default_rng(7).choice([-4.0, -2.0, 0.0, 3.0, 5.0], 60), 100)
    keep = np.exp(-GRID_STEP_S / 0.03)
    found = wheels_that_follow(commands, lfilter([1.0 - keep], [1.0, -keep], commands), 0.005)
    both = ("motor_lag", "command_delay")
    # The lag surely is there, however little it moves beside a delay; a delay is not.
    assert found.acceptable(("command_delay",), both)
    assert not found.acceptable(("motor_lag",), both)
    assert found.needed(both) == ("motor_lag",)


@pytest.mark.parametrize("hidden", ["turning_load", "deadband"])
def test_what_only_turning_loses_is_told_from_what_every_wheel_loses(hidden):
    rng = np.random.default_rng(12)
    commands = np.repeat(rng.choice([-4.0, -2.0, -0.5, 0.0, 1.0, 3.0, 5.0], (40, 2)), 50, axis=0)
    mean, half = commands.mean(axis=1), 0.5 * (commands[:, 1] - commands[:, 0])

    def less(speed):
        return np.sign(speed) * np.maximum(np.abs(speed) - 0.35, 0.0)

    turned = np.column_stack([mean - less(half), mean + less(half)])
    followed = turned if hidden == "turning_load" else less(commands)
    line = replace(line_of(followed + 0.05 * rng.standard_normal(commands.shape)), command_rad_s=commands)
    found = selector_of(wheels_on(line))
    # Starts and stops within a cell of the grid look like a short delay.
    assert [name for name in found.select() if name not in DELAY_NAMES] == [hidden]
    column = REGISTRY[hidden].columns[0]
    assert found.fit((hidden,)).vector[WHEEL.place[column]] == pytest.approx(0.35, abs=0.02)


def test_given_effects_stay_and_are_not_selected_again():
    assert selector(given=("turn_slip",), start=vector_of(turn_slip=0.08), turn_slip=0.08).select() == ("turn_slip",)


def test_what_moves_no_prediction_is_not_accepted():
    strict = selector(moves_m=1.0, turn_slip=0.08)
    assert strict.select() == ()
    assert not strict.acceptable((), ("turn_slip",))
    assert selector(turn_slip=0.08).acceptable((), ("turn_slip",))


def test_a_change_is_found_when_it_happens():
    channel, line = body_channel()
    perturbation = np.zeros((line.t_s.size, 3))
    omega = GEOMETRY[0] / GEOMETRY[1] * (line.speed_rad_s[:, 1] - line.speed_rad_s[:, 0])
    perturbation[:, 2] = np.where(line.t_s > 40.0, -omega * (1.0 - 1.0 / 1.12), 0.0)
    found = selector_of(moved_by(channel, perturbation))
    names = found.select()
    assert names == ("surface_change",)
    assert found.fit(names).vector[BODY.place["surface_change.time_s"]] == pytest.approx(40.0, abs=2.0)


def test_a_slow_drive_cannot_tell_lag_from_delay_and_says_so():
    def wheels_late(commands):
        return wheels_that_follow(commands, np.concatenate([np.full(20, commands[0]), commands[:-20]]))

    t_s = 0.01 * np.arange(6000)
    slow = wheels_late(3.0 + 2.0 * np.sin(2.0 * np.pi * t_s / 20.0))
    assert "motor_lag" in slow.rivals(("command_delay",), "command_delay")
    assert "command_delay" in slow.rivals(("motor_lag",), "motor_lag")
    steps = wheels_late(np.where(np.floor(t_s / 2.0) % 2 == 0, 4.0, -3.0))
    assert steps.rivals(("command_delay",), "command_delay") == ()


def judged(gain=30.0, score=30.0, without_two=10.0, moved_m=0.01, misfit=0.0, count=1000):
    """Whether one effect is accepted on top of none: its gain, proof, what it moves, and what the fit without lacks."""
    base = 0.5 * count * (1.0 + misfit)
    proof = EffectEvidence(gain, 50.0, 50.0, without_two, 1.0, score)
    return is_accepted((), ("turn_slip",), proof, (base, base - gain), moved_m=moved_m, count=count)


def test_an_effect_is_accepted_only_if_every_condition_holds():
    assert judged() is True
    assert judged(gain=10.1) is True
    # At the thresholds: twice the gain may be as large as the score asked for, the score has to be larger.
    assert judged(gain=10.0) is True
    assert judged(score=20.0) is False
    # A parameter of 1000 residuals costs 3.45 nats.
    assert judged(without_two=3.46) is True
    assert judged(gain=9.9) is False
    assert judged(score=19.9) is False
    assert judged(without_two=3.45) is False
    assert judged(without_two=-1.0) is False
    assert judged(moved_m=0.001) is False


@pytest.mark.parametrize(
    ("smaller", "new", "score", "accepted"),
    [
        (("command_delay",), ("motor_lag",), 20.1, True),
        (("deadband", "command_delay"), ("motor_lag",), 20.1, True),
        (("motor_lag",), ("command_delay",), 99.0, False),
        (("command_delay",), ("motor_lag",), 20.0, False),
        ((), ("motor_lag",), 99.0, False),
        ((), ("motor_lag", "command_delay"), 99.0, False),
        (("command_delay",), ("deadband",), 99.0, False),
        (("command_delay",), ("motor_lag", "deadband"), 99.0, False),
    ],
)
def test_a_lag_beside_a_delay_is_told_where_it_surely_is_however_little_it_moves(smaller, new, score, accepted):
    proof, limits = EffectEvidence(50.0, 40.0, 30.0, 20.0, 1.0, score), Thresholds(10.0, 0.001, 20.0)
    assert is_accepted(smaller, (*smaller, *new), proof, layout=WHEEL, limits=limits, moved_m=0.0009) == accepted


@pytest.mark.parametrize(
    ("layout", "smaller", "new", "accepted"),
    [
        (WHEEL, (), ("command_delay",), True),
        (WHEEL, ("motor_lag", "deadband"), ("command_delay",), True),
        (WHEEL, ("command_delay",), ("motor_lag",), False),
        (WHEEL, (), ("command_delay", "motor_lag"), False),
        (BODY, (), ("pose_latency",), False),
    ],
)
@pytest.mark.parametrize("score", [10.1, 10.0])
def test_a_delay_of_the_commands_needs_its_score_but_not_to_show_in_a_third_place(
    layout, smaller, new, accepted, score
):
    proof, limits = EffectEvidence(20.0, -1.0, -7.0, 0.0, 1.0, score), Thresholds(10.0, 0.001, 20.0)
    found = is_accepted(smaller, (*smaller, *new), proof, (500.0, 480.0), layout, limits, 0.01)
    assert found == (accepted and score > 10.0)


def test_what_fits_badly_is_helped_by_a_large_part_of_what_it_lacks_whatever_its_score():
    # 500 of 1000 residuals' half squares are expected: with a misfit of 2, 1000 are lacking.
    assert judged(score=-5.0, gain=260.0, misfit=2.0) is True
    assert judged(score=-5.0, gain=240.0, misfit=2.0) is False
    assert judged(score=-5.0, gain=250.0, misfit=2.0) is False
    assert judged(score=-5.0, gain=200.0, misfit=0.45) is False
    assert judged(score=-5.0, gain=200.0, misfit=0.5) is False
    assert judged(score=-5.0, gain=200.0, misfit=0.6) is True
    assert judged(score=-5.0, gain=260.0, misfit=2.0, without_two=-1.0) is False
    assert judged(score=-5.0, gain=260.0, misfit=2.0, moved_m=0.0) is False


def test_noise_that_wanders_is_named_by_gain_alone_and_not_by_the_rule():
    """Heading that wanders by itself: some effect always fits it, and no block of time repeats another."""
    channel, line = body_channel()
    rng = np.random.default_rng(11)
    steps = np.repeat(rng.standard_normal(line.t_s.size // 300 + 1), 300)[: line.t_s.size]
    perturbation = np.zeros((line.t_s.size, 3))
    perturbation[:, 2] = 0.03 * steps * (np.abs(line.speed_rad_s).max(axis=1) > 0.0)
    found = selector_of(moved_by(channel, perturbation))
    gains = {name: found.fit(()).cost - found.fit((name,)).cost for name in ("turn_slip", "surface_change")}
    assert max(gains.values()) > 20.0
    assert found.select() == ()


def test_candidates_come_in_order_of_what_they_promise_and_the_first_of_them_is_tried_first():
    found = selector(turn_slip=0.08, wheel_radius_asymmetry=0.004)
    ranked = found.ranked(())
    assert len(ranked) > 2
    promises = [found.promise((), name) for name in ranked]
    assert promises == sorted(promises, reverse=True)
    assert promises[-1] > 0.0
    assert ranked[0] == "turn_slip"
    others = set(candidates_of(BODY)) - set(ranked)
    assert all(found.promise((), name) <= 0.0 for name in others)
    assert "turn_slip" not in found.ranked(("turn_slip",))
    tried = []
    found.acceptable = lambda smaller, larger: tried.append(larger[-1])
    assert found.select() == ()
    assert tried[0] == "turn_slip"


class Circling(Selector):
    """A search that swaps and drops in a circle: none, the first, the second, both, the first; both fit best."""

    def ranked(self, accepted):
        return [name for name in ("side_slip", "turn_slip") if name not in accepted] or ["slope"]

    def acceptable(self, smaller, larger):
        return True

    def swapped(self, accepted):
        return accepted

    def needed(self, accepted):
        return {
            ("turn_slip", "side_slip"): ("side_slip", "turn_slip"),
            ("side_slip", "turn_slip", "slope"): ("turn_slip",),
        }.get(accepted, accepted)


class Stuck(Selector):
    """A search that nothing promises to go on."""

    def ranked(self, accepted):
        return []


def of_kind(kind, **effects):
    """A search of some kind on a drive of a robot that has these effects."""
    channel, _ = body_channel(**effects)
    return kind(channel, body_moves(channel), LIMITS)


def test_a_search_that_begins_with_a_stand_in_swaps_it_even_where_nothing_gains_on_top_of_it():
    assert of_kind(Stuck, turn_slip=0.08).select(("turn_asymmetry",)) == ("turn_slip",)


def test_a_search_that_comes_back_to_where_it_was_ends_with_the_best_set_on_its_way():
    both = of_kind(Circling, turn_slip=0.08, side_slip=0.1)
    assert both.select(("turn_slip",)) == ("side_slip", "turn_slip")
    # One that is next to nothing worth is not the best, as its price is paid.
    assert of_kind(Circling, turn_slip=0.08).select(("turn_slip",)) == ("turn_slip",)


def test_the_price_of_an_effect_is_that_of_all_its_parameters():
    channel = SimpleNamespace(settings=DEFAULT_SETTINGS, count=1000)
    fitted = Selector(channel, lambda small, big: 1.0, LIMITS)
    fitted.fits = {frozenset(): fit_at(700.0), frozenset({"wheel_gain"}): fit_at(650.0)}
    # Left and right: half of 2 ln(1000).
    assert fitted.promise((), "wheel_gain") == pytest.approx(50.0 - np.log(1000))
    assert fitted._worth((), ("wheel_gain",), "wheel_gain") == pytest.approx(50.0 - np.log(1000))
    assert fitted.priced(("wheel_gain",)) == pytest.approx(650.0 + np.log(1000))
    assert fitted.priced(()) == 700.0


def test_what_promises_nothing_to_first_order_is_not_fitted():
    found = selector()
    assert found.promise((), "turn_slip") < 0.0
    assert frozenset({"turn_slip"}) not in found.fits
    # What begins from several starts promises nothing to first order: it is fitted.
    found.promise((), "pose_latency")
    assert frozenset({"pose_latency"}) in found.fits
    slipping = selector(turn_slip=0.08)
    assert slipping.promise((), "turn_slip") > 0.0
    assert frozenset({"turn_slip"}) in slipping.fits


def test_a_set_is_settled_after_every_step_and_the_steps_end_where_nothing_is_accepted():
    found = Selector(SimpleNamespace(settings=DEFAULT_SETTINGS), lambda small, big: 1.0, LIMITS)
    found.ranked = lambda accepted: [name for name in ("side_slip", "turn_slip", "slope") if name not in accepted]
    found.acceptable = lambda smaller, larger: larger[-1] != "slope"
    settled = []
    assert found.greedy(settle=lambda of, names: settled.append(names)) == ("side_slip", "turn_slip")
    assert settled == [("side_slip",), ("side_slip", "turn_slip")]
    assert found.greedy(("turn_slip",)) == ("turn_slip", "side_slip")


def test_what_is_proved_rests_on_exact_fits_and_what_competes_on_loose_ones():
    found = selector(turn_slip=0.08)
    loose = found.fit(("turn_slip",))
    assert loose.loose
    found.evidence((), ("turn_slip",))
    exact = found.fit(("turn_slip",))
    assert not exact.loose
    assert found.exact(("turn_slip",)) is exact
    assert abs(exact.cost - loose.cost) < DEFAULT_SETTINGS.fit.enough_nats
    assert exact.vector == pytest.approx(loose.vector, rel=1e-3, abs=1e-5)
