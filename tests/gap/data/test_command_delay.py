"""The pieces of the commands' alignment with the wheels, each against what is computed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import timing
from disco_hw.gap.data.timing import command_delay_s
from disco_hw.gap.settings import GridSettings
from disco_hw.log.drive import Commands, Wheels

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


@pytest.mark.parametrize("lag_s", [0.0, 0.3])
def test_wheels_answer_each_change_of_a_command_by_itself(lag_s):
    commands = commands_at([2.0, 2.3, 2.5, 3.1, 4.0], [(1.0, -2.0), (4.0, 0.0), (-3.0, 0.5), (2.0, 2.0), (0.0, 1.0)])
    asked = np.column_stack([commands.left_rad_s, commands.right_rad_s])
    state, angle = np.empty((5, 2)), np.empty((5, 2))
    timing._answer(commands.t_s, asked, lag_s, state, angle)
    speed, way = answered(commands, lag_s, commands.t_s)
    if lag_s:
        np.testing.assert_allclose(state, speed, atol=1e-12)
    else:
        # Just before a change they are as fast as was asked until then.
        np.testing.assert_allclose(state[1:], asked[:-1], atol=1e-12)
    np.testing.assert_allclose(angle, way, atol=1e-12)


def of_regression(columns, measured):
    """Minus the log likelihood of a sample, of a regression by Huber's weights whose steps are decompositions."""
    weight = np.ones(measured.size)
    for _ in range(4):
        fitted = np.linalg.lstsq(columns * weight[:, None], measured * weight, rcond=None)[0]
        left = np.abs(measured - columns @ fitted)
        limit = 2.0 * 1.4826 * np.median(left) + 1e-9
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(left, 1e-12)))
    return 0.5 * np.log(np.where(left < limit, left**2, limit * (2.0 * left - limit)).mean() + 1e-10)


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
    turned = [rng.normal(0.5, 1.0, 150), rng.normal(0.4, 1.0, 150)]
    return commands, (begin, end, segment), turned


def by_hand(commands, pairs, turned, delay_s, lag_s):
    """How many pairs are known, and their misfit."""
    begin, end, segment = pairs
    known = np.ones(begin.size, dtype=bool)
    for at in (begin - delay_s, end - delay_s):
        known &= (at >= commands.t_s[0]) & (at <= commands.t_s[-1])
        # In force is the last that was stamped by then.
        place = np.array([np.flatnonzero(commands.t_s <= each)[-1] if each >= 0.0 else 0 for each in at])
        known &= commands.segment[place] == segment
    # From 10 to 11 s nothing is known.
    known &= (end - delay_s <= 10.0) | (begin - delay_s >= 11.0)
    ways = [answered(commands, lag_s, at - delay_s)[1] for at in (begin, end)]
    moved = (ways[1] - ways[0])[known]
    columns = np.column_stack([moved[:, 1] - moved[:, 0], moved[:, 1] + moved[:, 0]])
    return int(known.sum()), sum(of_regression(columns, of[known]) for of in turned)


@pytest.mark.parametrize(("delay_s", "lag_s"), [(0.0, 0.0), (0.33, 0.0), (-0.4, 0.2), (0.12, 0.5)])
def test_what_wheels_turn_is_fitted_by_what_both_commands_make_them_turn(delay_s, lag_s):
    commands, pairs, turned = driven()
    count, misfit = by_hand(commands, pairs, turned, delay_s, lag_s)
    assert 100 < count < 140
    delays = np.array([90.0, delay_s, -90.0])
    found = timing._command_misfits(commands, pairs, turned, delays, lag_s, replace(SETTINGS, fewest_poses=count))
    assert found == pytest.approx([np.inf, misfit, np.inf], rel=1e-9)
    few = timing._command_misfits(commands, pairs, turned, delays, lag_s, replace(SETTINGS, fewest_poses=count + 1))
    assert (few == np.inf).all()


def test_a_pair_is_known_from_the_first_command_to_the_last_and_up_to_one_that_is_not_known():
    commands = commands_at([1.0, 2.0, 3.0, 4.0, 5.0, 6.0], [(1, 2), (3, 1), (2, 2), (np.nan, np.nan), (4, 4), (1, 0)])
    settings = replace(SETTINGS, fewest_poses=1)
    for begin_s, end_s, known in (
        (1.0, 2.0, True), (0.99, 2.0, False), (2.5, 4.0, True), (2.5, 4.01, False), (4.99, 5.5, False),
        (5.0, 6.0, True), (5.5, 6.01, False),
    ):  # fmt: skip
        pairs = np.array([begin_s]), np.array([end_s]), np.array([0])
        misfit = timing._command_misfits(commands, pairs, [np.ones(1)] * 2, np.zeros(1), 0.0, settings)
        assert np.isfinite(misfit[0]) == known


def test_what_was_not_known_right_after_the_first_command_is_not_known():
    commands = commands_at([1.0, 2.0, 2.25, 3.0], [(1, 2), (np.nan, np.nan), (2, 2), (4, 4)])
    settings = replace(SETTINGS, fewest_poses=1)
    for begin_s, end_s, known in ((1.5, 2.0, True), (1.5, 2.125, False), (1.5, 2.5, False), (2.25, 2.5, True)):
        pairs = np.array([begin_s]), np.array([end_s]), np.array([0])
        misfit = timing._command_misfits(commands, pairs, [np.ones(1)] * 2, np.zeros(1), 0.0, settings)
        assert np.isfinite(misfit[0]) == known


def sampled(count=400, period_s=0.05, segment=0):
    """Wheels at even samples that turn at 2 and 3 rad/s."""
    t_s = period_s * np.arange(count)
    return Wheels(t_s, 2.0 * t_s, 3.0 * t_s, 0.0 * t_s, 0.0 * t_s, np.full(count, segment), True, True)


ONE = commands_at([0.0, 1.0], [(1.0, 1.0), (2.0, 2.0)])


@pytest.fixture
def scanned(monkeypatch):
    """What is told where the misfit is a parabola about a delay for each lag; what was asked for."""
    asked = []

    def told(lowest, wheels=None, commands=ONE, known=True, **settings):
        asked.clear()

        def misfits(commands, pairs, turned, delays, lag_s, settings):
            asked.append((pairs, turned, delays, lag_s))
            if not known:
                return np.full(delays.size, np.inf)
            at_s, depth = lowest.get(lag_s, (0.0, 0.0))
            return -np.maximum(depth - 100.0 * (delays - at_s) ** 2, 0.0)

        monkeypatch.setattr(timing, "_command_misfits", misfits)
        chosen = replace(SETTINGS, lags_s=(0.1, 0.3), lag_reach_s=0.11, **settings)
        return command_delay_s(sampled() if wheels is None else wheels, commands, chosen)

    told.asked = asked
    return told


def test_a_delay_is_found_between_those_that_are_tried_without_a_lag_and_with_each_as_long_in_all(scanned):
    assert scanned({0.0: (0.247, 1.0)}) == pytest.approx(0.247)
    delays, *shorter = [delays for _, _, delays, _ in scanned.asked]
    assert delays == pytest.approx(0.02 * np.arange(-50, 51))
    # Nearest to the best is 0.24.
    assert shorter[0] == pytest.approx(0.24 - 0.1 + 0.02 * np.arange(-5, 6))
    assert shorter[1] == pytest.approx(0.24 - 0.3 + 0.02 * np.arange(-5, 6))
    assert [lag_s for *_, lag_s in scanned.asked] == [0.0, 0.1, 0.3]
    assert scanned({0.0: (0.247, 1.0), 0.1: (0.151, 1.1)}) == pytest.approx(0.151)
    assert scanned({0.0: (0.247, 1.0), 0.1: (0.151, 0.9)}) == pytest.approx(0.247)
    # The best of all counts, and not the last that is better than the first.
    assert scanned({0.0: (0.247, 1.0), 0.1: (0.151, 1.3), 0.3: (-0.049, 1.2)}) == pytest.approx(0.151)


def test_where_the_longest_delay_or_lag_fits_best_no_delay_is_known(scanned):
    assert scanned({0.0: (0.5, 1.0), 0.3: (0.2, 1.1)}) is None
    for at_s, known in ((1.0, False), (0.98, True), (-1.0, False), (-0.98, True)):
        told = scanned({0.0: (at_s, 1.0)})
        assert (told is not None) == known
        assert not known or told == pytest.approx(at_s)


def test_a_delay_of_commands_is_told_where_it_stands_out(scanned):
    for depth, told in ((0.051, 0.24), (0.049, 0.0)):
        assert scanned({0.0: (0.24, depth)}) == pytest.approx(told)
    # With a lag it may do so though not without.
    assert scanned({0.0: (0.24, 0.04), 0.1: (0.14, 0.06)}) == pytest.approx(0.14)
    assert scanned({0.0: (0.24, 0.5)}, least_delay_nats=0.5) == pytest.approx(0.24)
    # It is not known, but it does not stand out either.
    assert scanned({0.0: (1.0, 0.04)}) == 0.0
    assert scanned({}, known=False) == 0.0
    assert len(scanned.asked) == 1


def test_pairs_lie_as_far_apart_as_poses_or_as_samples_come_and_are_thinned(scanned):
    wheels = sampled(segment=7)
    scanned({0.0: (0.24, 1.0)}, wheels)
    (begin, end, segment), turned, *_ = scanned.asked[0]
    assert begin == pytest.approx(wheels.t_s[:392])
    assert end - begin == pytest.approx(0.4)
    assert (segment == 7).all()
    assert turned == [pytest.approx(0.8), pytest.approx(1.2)]
    scanned({0.0: (0.24, 1.0)}, sampled(period_s=0.7))
    assert scanned.asked[0][0][1] - scanned.asked[0][0][0] == pytest.approx(0.7)
    for most, every in ((392, 1), (197, 1), (196, 2), (100, 3)):
        scanned({0.0: (0.24, 1.0)}, wheels, most_command_pairs=most)
        assert scanned.asked[0][0][0] == pytest.approx(wheels.t_s[:392:every])
        assert scanned.asked[0][0][1] == pytest.approx(wheels.t_s[:392:every] + 0.4)


def test_too_few_samples_or_commands_have_no_delay(scanned):
    found = {0.0: (0.24, 1.0)}
    none = Commands(*(of[:1] for of in (ONE.t_s, ONE.left_rad_s, ONE.right_rad_s, ONE.segment)))
    assert scanned(found, commands=none) == 0.0
    # Two samples make one pair.
    assert scanned(found, sampled(2, 0.4), fewest_poses=1) == pytest.approx(0.24)
    assert scanned(found, sampled(1, 0.4), fewest_poses=0) == 0.0
    for fewest, told in ((392, 0.24), (393, 0.0)):
        assert scanned(found, fewest_poses=fewest) == pytest.approx(told)
