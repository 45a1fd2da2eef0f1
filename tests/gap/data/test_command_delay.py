"""The pieces of the commands' alignment with the wheels, each against what is computed by hand."""

import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest

from disco_hw.gap.data.command_timing import (
    Response,
    Turned,
    WheelResponse,
    _integrate_response,
    command_clock,
    response,
)
from disco_hw.gap.data.stamp_clock import StampClock, picked
from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands, Wheels
from tests.gap.synthetic import of_regression

SETTINGS = GridSettings()


def answered(commands, lag_s, t_s):
    """Speeds and ways (N, 2) of wheels that follow held commands with a lag: each change answers for itself."""
    asked = np.nan_to_num(np.column_stack([commands.left_rad_s, commands.right_rad_s]))
    changes = np.diff(asked, axis=0)
    speed, way = np.tile(asked[0], (t_s.size, 1)), np.outer(t_s - commands.t_s[0], asked[0])
    for at_s, change in zip(commands.t_s[1:], changes, strict=True):
        since = np.maximum(t_s - at_s, 0.0)
        share = 1.0 - np.exp(-since / lag_s) if lag_s else (t_s >= at_s).astype(float)
        speed += np.outer(share, change)
        way += np.outer(since - lag_s * share, change)
    return speed, way


def commands_at(t_s, asked, segment=0):
    return Commands(np.asarray(t_s, dtype=float), *np.asarray(asked, dtype=float).T, np.full(len(t_s), segment))


def test_angles_at_a_few_times_take_no_more_memory_from_a_log_of_hours():
    count = 100_000
    commands = commands_at(0.02 * np.arange(count), np.ones((count, 2)))
    model = WheelResponse.of(commands, 0.3)
    tracemalloc.start()
    try:
        model._angles(np.linspace(5.0, 15.0, 60))
        peak_bytes = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak_bytes < count


@pytest.mark.parametrize("lag_s", [0.0, 0.3])
def test_wheels_answer_each_change_of_a_command_by_itself(lag_s):
    commands = commands_at([2.0, 2.3, 2.5, 3.1, 4.0], [(1.0, -2.0), (4.0, 0.0), (-3.0, 0.5), (2.0, 2.0), (0.0, 1.0)])
    asked = np.column_stack([commands.left_rad_s, commands.right_rad_s])
    answer = WheelResponse.of(commands, lag_s)
    state, angle = answer.speed, answer.angle
    speed, way = answered(commands, lag_s, commands.t_s)
    if lag_s:
        np.testing.assert_allclose(state, speed, atol=1e-12)
    else:
        # Just before a change they are as fast as was asked until then.
        np.testing.assert_allclose(state[1:], asked[:-1], atol=1e-12)
    np.testing.assert_allclose(angle, way, atol=1e-12)


@pytest.mark.parametrize("lag_s", [0.0, 0.3])
def test_two_commands_at_one_instant_count_as_the_later_one(lag_s):
    t_s, asked = np.array([2.0, 2.5, 2.5, 3.0]), np.array([(1.0, -2.0), (4.0, 0.0), (-3.0, 0.5), (2.0, 2.0)])
    speed, angle = np.full((2, 4, 2), np.nan)
    _integrate_response(t_s, asked, np.zeros(4, np.int64), lag_s, speed, angle)
    alone = WheelResponse.of(commands_at(t_s[[0, 2, 3]], asked[[0, 2, 3]]), lag_s)
    np.testing.assert_allclose(speed[[0, 1, 3]], alone.speed, atol=1e-12)
    np.testing.assert_allclose(angle[[0, 1, 3]], alone.angle, atol=1e-12)


def test_a_segment_begins_with_wheels_that_follow_its_first_command():
    asked = [(1.0, -2.0), (4.0, 0.0), (-3.0, 0.5), (2.0, 2.0)]
    both = replace(commands_at([2.0, 2.3, 2.5, 3.1], asked), segment=np.array([0, 0, 1, 1]))
    late = WheelResponse.of(both, 0.3)
    own = WheelResponse.of(commands_at([2.5, 3.1], asked[2:]), 0.3)
    np.testing.assert_allclose(late.speed[2:], own.speed, atol=1e-12)
    np.testing.assert_allclose(late.angle[3] - late.angle[2], own.angle[1], atol=1e-12)


def driven(seed=2):
    """Commands over two segments, a stretch of which is not known, pairs of instants and what wheels turned between."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(100) * 0.25
    asked = rng.normal(1.0, 3.0, (100, 2))
    asked[40:44] = np.nan
    commands = Commands(t_s, *asked.T, np.where(t_s < 15.0, 3, 4))
    begin = np.sort(rng.uniform(-1.0, 25.5, 150))
    end = begin + rng.uniform(0.3, 0.5, 150)
    segment = np.where(begin < 15.0, 3, 4)
    return commands, Turned(begin, end, segment, rng.normal(0.5, 1.0, 150), rng.normal(0.4, 1.0, 150))


def by_hand(commands, turned, delay_s, lag_s):
    """How many pairs are known, and their misfit."""
    begin, end, segment = turned.begin_s, turned.end_s, turned.segment
    known = np.ones(begin.size, dtype=bool)
    for at in (begin - delay_s, end - delay_s):
        known &= (at >= commands.t_s[0]) & (at <= commands.t_s[-1])
        # In force is the last that was stamped by then.
        place = np.array([np.flatnonzero(commands.t_s <= each)[-1] if each >= 0.0 else 0 for each in at])
        known &= commands.segment[place] == segment
    # From 10 to 11 s nothing is known.
    known &= (end - delay_s <= 10.0) | (begin - delay_s >= 11.0)
    moved = np.zeros((begin.size, 2))
    for number in (3, 4):
        own = picked(commands, commands.segment == number)
        ways = [answered(own, lag_s, at - delay_s)[1] for at in (begin, end)]
        moved = np.where((segment == number)[:, None], ways[1] - ways[0], moved)
    moved = moved[known]
    columns = np.column_stack([moved[:, 1] - moved[:, 0], moved[:, 1] + moved[:, 0]])
    return int(known.sum()), sum(of_regression(columns, of[known]) for of in (turned.left_rad, turned.right_rad))


@pytest.mark.parametrize(("delay_s", "lag_s"), [(0.0, 0.0), (0.33, 0.0), (-0.4, 0.2), (0.12, 0.5)])
def test_what_wheels_turn_is_fitted_by_what_both_commands_make_them_turn(delay_s, lag_s):
    commands, turned = driven()
    count, misfit = by_hand(commands, turned, delay_s, lag_s)
    assert 100 < count < 140
    delays, answer = np.array([90.0, delay_s, -90.0]), WheelResponse.of(commands, lag_s)
    assert answer.mismatches(turned, delays, count) == pytest.approx([np.inf, misfit, np.inf], rel=1e-9)
    assert (answer.mismatches(turned, delays, count + 1) == np.inf).all()
    assert np.count_nonzero(answer.known(turned, delay_s)) == count


def test_a_pair_is_known_from_the_first_command_to_the_last_and_up_to_one_that_is_not_known():
    def known(t_s, unknown, *pairs):
        asked = np.random.default_rng(0).normal(0.0, 3.0, (len(t_s), 2))
        asked[unknown] = np.nan
        turned = Turned(*np.transpose(pairs), np.zeros(len(pairs), np.int64), *np.ones((2, len(pairs))))
        return WheelResponse.of(commands_at(t_s, asked), 0.0).known(turned, 0.0).tolist()

    assert known(range(1, 7), 3, (1.0, 2.0), (2.5, 4.0), (5.0, 6.0)) == [True] * 3
    assert known(range(1, 7), 3, (0.99, 2.0), (2.5, 4.01), (4.99, 5.5), (5.5, 6.01)) == [False] * 4
    # Right after the first command.
    assert known([1.0, 2.0, 2.25, 3.0], 1, (1.5, 2.0), (2.25, 2.5)) == [True] * 2
    assert known([1.0, 2.0, 2.25, 3.0], 1, (1.5, 2.125), (1.5, 2.5)) == [False] * 2


def sampled(count=400, period_s=0.05, segment=0):
    """Wheels at even samples that turn at 2 and 3 rad/s."""
    t_s = period_s * np.arange(count)
    return Wheels(t_s, 2.0 * t_s, 3.0 * t_s, 0.0 * t_s, 0.0 * t_s, np.full(count, segment), True, True)


ONE = commands_at([0.0, 30.0], [(1.0, 1.0), (2.0, 2.0)])


@pytest.fixture
def scanned(monkeypatch):
    """What is told where the misfit is a parabola about a delay for each lag, and commands known up to some delay."""
    asked = []

    def told(lowest, wheels=None, commands=ONE, known_s=9.0, shared=True, **settings):
        asked.clear()

        def misfits(answer, turned, delays, fewest):
            asked.append((turned, delays, answer.lag_s))
            at_s, depth = lowest.get(answer.lag_s, (0.0, 0.0))
            there = -np.maximum(depth - 100.0 * (delays - at_s) ** 2, 0.0)
            counts = np.array([np.count_nonzero(answer.known(turned, each)) for each in delays])
            return np.where(counts >= fewest, there, np.inf)

        def known(answer, turned, delay_s):
            # One pair in three is lost where commands are not known.
            return (np.arange(turned.begin_s.size) % 3 > 0) | (abs(delay_s) <= known_s)

        monkeypatch.setattr(WheelResponse, "mismatches", misfits)
        monkeypatch.setattr(WheelResponse, "known", known)
        monkeypatch.setattr(WheelResponse, "is_distinct", lambda *_: shared)
        chosen = replace(SETTINGS, **({"lags_s": (0.1, 0.3), "lag_reach_s": 0.12} | settings))
        return response(Turned.of(sampled() if wheels is None else wheels, chosen), commands, chosen)

    told.asked = asked
    return told


def test_a_delay_is_found_between_those_that_are_tried_without_a_lag_and_with_each_as_long_in_all(scanned):
    assert scanned({0.0: (0.247, 1.0)}).delay_s == pytest.approx(0.247, abs=1e-3)
    scans = [(delays, lag_s) for _, delays, lag_s in scanned.asked if delays.size > 1]
    # Some lags over all delays, and then each about the best.
    for delays, _ in scans[:2]:
        assert delays == pytest.approx(0.04 * np.arange(-25, 26))
    assert [lag_s for _, lag_s in scans] == [0.0, 0.3, 0.0, 0.1, 0.3]
    for delays, lag_s in scans[2:]:
        assert delays == pytest.approx(0.247 - lag_s + 0.02 * np.arange(-6, 7), abs=1e-3)
    for first, shorter, found in (
        ((0.247, 1.0), {0.1: (0.151, 1.1)}, (0.151, 0.1)),
        ((0.247, 1.0), {0.1: (0.151, 0.9)}, (0.247, 0.0)),
        # The best of all counts, and not the last that is better than the first.
        ((0.247, 1.0), {0.1: (0.151, 1.3), 0.3: (-0.049, 1.2)}, (0.151, 0.1)),
    ):
        told = scanned({0.0: first, **shorter})
        assert (told.delay_s, told.lag_s) == (pytest.approx(found[0], abs=1e-3), found[1])
        assert told.known


def test_every_third_lag_is_scanned_and_the_rest_about_the_delay_that_these_show(scanned):
    lags_s = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
    told = scanned({0.25: (-0.5, 0.2), 0.15: (-0.4, 0.9)}, lags_s=lags_s)
    assert (told.delay_s, told.lag_s) == (pytest.approx(-0.4, abs=1e-3), 0.15)
    scans = [lag_s for _, delays, lag_s in scanned.asked if delays.size == 51]
    assert scans == [0.0, 0.1, 0.25]


def test_only_lags_that_may_fit_best_are_looked_at_between_the_steps_of_the_scan(scanned):
    told = scanned({0.0: (0.247, 1.0), 0.1: (0.147, 0.97), 0.3: (-0.053, 0.9)}, least_delay_nats=0.05)
    assert told.lag_s == 0.0
    # The best of the scan first, and then those that are close to it.
    closely = [lag_s for _, delays, lag_s in scanned.asked if delays.size == 1]
    assert list(dict.fromkeys(closely)) == [0.0, 0.1]
    assert scanned({0.0: (0.24, 1.0)}, least_delay_nats=0.0).delay_s == pytest.approx(0.24, abs=1e-3)


def test_lags_are_told_apart_where_they_fit_best_and_not_at_the_steps_of_the_scan(scanned):
    # At the steps of the scan about 0.247 a lag of 0.1 s fits no better.
    told = scanned({0.0: (0.247, 1.0), 0.1: (0.157, 1.005)})
    assert (told.delay_s, told.lag_s) == (pytest.approx(0.157, abs=1e-3), 0.1)
    assert told.mismatch == pytest.approx(-1.005, abs=1e-3)


def test_where_the_longest_delay_or_lag_fits_best_no_delay_is_known(scanned):
    # Behind the longest lag a delay is where the log is laid, though it need not be the one.
    told = scanned({0.0: (0.5, 1.0), 0.3: (0.2, 1.1)})
    assert (told.delay_s, told.known) == (pytest.approx(0.2, abs=1e-3), False)
    for at_s, known in ((1.0, False), (0.96, True), (-1.0, False), (-0.96, True)):
        told = scanned({0.0: (at_s, 1.0)})
        assert told.known == known
        assert told.delay_s == (pytest.approx(at_s, abs=1e-3) if known else 0.0)


def test_delays_at_which_a_quarter_of_the_pairs_is_lost_are_none(scanned):
    assert scanned({0.0: (0.4, 1.0)}).known
    assert scanned({0.0: (0.4, 1.0)}, known_s=0.5).delay_s == pytest.approx(0.4, abs=1e-3)
    # The next one that would be longer has lost them.
    told = scanned({0.0: (0.48, 1.0)}, known_s=0.5)
    assert (told.delay_s, told.known) == (0.0, False)
    # Of the next but one nothing is asked.
    for at_s, known in ((0.44, True), (-0.44, True), (-0.48, False)):
        assert scanned({0.0: (at_s, 1.0)}, known_s=0.5).known == known


def test_a_delay_of_commands_is_told_where_it_stands_out_among_others_and_for_the_same_pairs(scanned):
    for depth, told in ((0.051, 0.24), (0.049, 0.0)):
        found = scanned({0.0: (0.24, depth)})
        assert (found.delay_s, found.known) == (pytest.approx(told, abs=1e-3), told > 0.0)
    # With a lag it may do so though not without.
    assert scanned({0.0: (0.24, 0.04), 0.1: (0.14, 0.06)}).delay_s == pytest.approx(0.14, abs=1e-3)
    assert scanned({0.0: (0.24, 0.5)}, least_delay_nats=0.49).delay_s == pytest.approx(0.24, abs=1e-3)
    assert scanned({0.0: (0.24, 1.0)}, shared=False) == Response(known=False)


@pytest.mark.parametrize(("by_s", "told"), [(0.0, True), (0.1, True), (0.3, False)])
def test_the_same_pairs_fit_worse_at_a_shorter_and_at_a_longer_delay(by_s, told):
    t_s = np.arange(0.0, 60.0, 0.1)
    rng = np.random.default_rng(3)
    commands = commands_at(t_s[::10], rng.normal(0.0, 3.0, (60, 2)))
    begin = np.arange(2.0, 55.0, 0.2)
    way = [answered(commands, 0.0, at)[1] for at in (begin - 0.2, begin + 0.2)]
    turned = Turned(begin, begin + 0.4, np.zeros(begin.size, np.int64), *(way[1] - way[0]).T)
    answer = WheelResponse.of(commands, 0.0)
    assert answer.is_distinct(turned, 0.2 + by_s, 0.15) == told
    steady = WheelResponse.of(commands_at(t_s, np.ones((600, 2))), 0.0)
    assert not steady.is_distinct(turned, 0.2, 0.15)
    assert not answer.is_distinct(turned, 90.0, 0.15)


@pytest.mark.parametrize(
    ("shorter", "longer", "told"),
    [(0.2, 0.2, True), (0.2, 0.0, False), (0.0, 0.2, False), (0.2, 1e-4, False), (1.1e-4, 0.2, True)],
)
def test_both_fit_worse_for_the_pairs_that_are_known_at_all_three(monkeypatch, shorter, longer, told):
    known = {0.1: [1, 1, 0, 1], 0.3: [1, 0, 1, 1], 0.5: [1, 1, 1, 0]}
    misfits = {0.1: shorter, 0.3: 0.0, 0.5: longer}
    seen = []

    def misfit(answer, turned, delay_s):
        seen.append(turned.begin_s.tolist())
        return misfits[round(delay_s, 9)]

    monkeypatch.setattr(WheelResponse, "known", lambda answer, turned, delay_s: np.array(known[round(delay_s, 9)]) > 0)
    monkeypatch.setattr(WheelResponse, "_mismatch", misfit)
    pairs = Turned(np.arange(4.0), *(np.arange(4.0),) * 4)
    assert WheelResponse.of(ONE, 0.0).is_distinct(pairs, 0.3, 0.2) is told
    assert seen == [[0.0]] * 3


def test_pairs_lie_as_far_apart_as_poses_or_as_samples_come_and_are_thinned():
    wheels = sampled(segment=7)
    turned = Turned.of(wheels, SETTINGS)
    assert turned.begin_s == pytest.approx(wheels.t_s[:392])
    assert turned.end_s - turned.begin_s == pytest.approx(0.4)
    assert (turned.segment == 7).all()
    assert (turned.left_rad, turned.right_rad) == (pytest.approx(0.8), pytest.approx(1.2))
    rare = Turned.of(sampled(period_s=0.7), SETTINGS)
    assert rare.end_s - rare.begin_s == pytest.approx(0.7)
    for most, every in ((392, 1), (197, 1), (196, 2), (100, 3)):
        turned = Turned.of(wheels, replace(SETTINGS, most_command_pairs=most))
        assert turned.begin_s == pytest.approx(wheels.t_s[:392:every])
        assert turned.end_s == pytest.approx(wheels.t_s[:392:every] + 0.4)
    part = Turned.of(wheels, SETTINGS).between(1.0, 2.0)
    assert part.begin_s == pytest.approx(np.arange(1.0, 2.0, 0.05))
    assert part.left_rad.size == part.end_s.size == part.segment.size == 20


@pytest.mark.filterwarnings("error")
def test_a_single_sample_makes_no_pair():
    none = Turned.of(sampled(1), SETTINGS)
    assert [getattr(none, each.name).size for each in fields(none)] == [0] * 5


def test_too_few_samples_or_commands_have_no_delay_and_nothing_is_asked_of_it(scanned):
    found = {0.0: (0.24, 1.0)}
    none = picked(ONE, np.array([True, False]))
    assert scanned(found, commands=none) == Response(delay_s=0.0, lag_s=0.0, mismatch=0.0, known=True)
    # Two samples make one pair.
    assert scanned(found, sampled(2, 0.4), fewest_samples=1).delay_s == pytest.approx(0.24, abs=1e-3)
    assert scanned(found, sampled(1, 0.4), fewest_samples=1) == Response()
    for fewest, told in ((392, True), (393, False)):
        assert (scanned(found, fewest_samples=fewest).delay_s > 0.2) == told
    assert command_clock(sampled(), none, SETTINGS) == (StampClock(0.0), True)
