"""Whole searches of a channel on a short drive whose truth is known, and how lag and delay are fitted first."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.search import channel_search
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.channel_search import evaluated_channel, responding, search_body, search_wheels, stamped, timed
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.search.richest_model import DELAY_COLUMNS, DELAY_NAMES, DELAY_STARTS_S, indices, smooth_of
from disco_hw.gap.search.selection import Selector
from disco_hw.gap.search.unnamed_terms import WithTerms, body_terms
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from tests.gap.synthetic import (
    DRIVE,
    GEOMETRY,
    LIMITS,
    NOISE,
    answered,
    body_channel,
    fit_at,
    line_of,
    moved_by,
    vector_of,
    wheels_on,
)
from tests.tables import thinned

READ_TO_RAD = 1e-3


def wheels_of(extra=None, settings=DEFAULT_SETTINGS, drive=DRIVE * 3, **effects):
    """Wheels read with some noise that answer their commands with these first parameters of effects."""
    command = np.repeat(np.array(drive, dtype=float), 200, axis=0)
    line = answered(command, None if extra is None else extra(command), **effects)
    noise = READ_TO_RAD * np.random.default_rng(3).standard_normal((line.encoder.node.size, 2))
    return replace(line, settings=settings, encoder_angle_rad=line.encoder_angle_rad + noise)


def found_on(line, start=WHEEL.neutral, given=()):
    """What is found of a drive's wheels."""
    return search_wheels(line, np.array(GEOMETRY), start, given)


def test_what_slows_the_wheels_is_named_and_the_rest_is_what_they_are_read_with():
    found = found_on(wheels_of(motor_lag=0.15, drive=DRIVE * 2))
    assert found.names == ("motor_lag",)
    assert not found.unnamed
    assert found.fit.vector[WHEEL.place["motor_lag.tau_s"]] == pytest.approx(0.15, abs=0.002)
    assert found.channel.noise.reading_rad == pytest.approx(READ_TO_RAD, rel=0.1)
    # Half a square each.
    assert found.fit.cost == pytest.approx(0.5 * found.channel.count, rel=0.1)
    assert found.base.cost > 2.0 * found.fit.cost
    assert found.richest.shape == found.fit.residual.shape
    # Nothing else is there that a richer model could take.
    assert found.richest @ found.richest == pytest.approx(2.0 * found.fit.cost, rel=0.02)
    assert found.richest_parameters > WHEEL.neutral.size


def test_what_a_model_knows_of_the_wheels_is_refitted_and_not_found():
    found = found_on(wheels_of(motor_lag=0.15, drive=DRIVE), vector_of(WHEEL, motor_lag=0.1), ("motor_lag",))
    assert found.names == found.selector.given == ("motor_lag",)
    assert found.base.vector[WHEEL.place["motor_lag.tau_s"]] == pytest.approx(0.15, abs=0.002)


def assert_same_but_later(fits, place, by_s):
    """Assert that the second of two fits is the first to the last bit, but for one entry that is later."""
    first, second = fits
    assert first.cost == second.cost
    np.testing.assert_array_equal(first.residual, second.residual)
    assert second.vector[place] == pytest.approx(first.vector[place] + by_s, abs=1e-15)
    np.testing.assert_array_equal(np.delete(first.vector, place), np.delete(second.vector, place))


@pytest.mark.thorough
@thinned("curved", [0.0, -0.02], quick=1)
def test_commands_are_searched_alike_to_the_last_bit_wherever_they_are_stamped(curved):
    """A delay that is counted from other stamps is rounded otherwise, and what it leads to may be another set."""
    line = wheels_of(lambda u: curved * u * np.abs(u), motor_lag=0.15)
    plain, moved = (found_on(replace(line, commands_moved_s=seen_s)) for seen_s in (0.0, -0.3))
    assert set(moved.names) == {*plain.names, "command_delay"}
    assert [one.term.model_name for one in moved.unnamed] == [one.term.model_name for one in plain.unnamed]
    assert len(plain.unnamed) == (curved != 0.0)
    ends = [found.selector.fits[frozenset(moved.names)] for found in (plain, moved)]
    assert_same_but_later(ends, WHEEL.place["command_delay.delay_s"], -0.3)


@pytest.mark.thorough
@thinned("late_s", [0.0, 0.3], quick=1)
def test_poses_are_searched_alike_to_the_last_bit_wherever_they_are_stamped(late_s):
    channel, line = body_channel(turn_slip=0.08)
    plain, moved = (
        search_body(replace(line, pose_delay_s=late_s + by_s, poses_moved_s=late_s + by_s), channel.neutral)
        for by_s in (0.0, -0.25)
    )
    both = ("pose_latency", "turn_slip")
    assert {"turn_slip"} <= set(plain.names) <= set(both)
    assert {"turn_slip"} <= set(moved.names) <= set(both)
    late = BODY.place["pose_latency.latency_s"]
    assert_same_but_later([found.selector.fits[frozenset(both)] for found in (plain, moved)], late, -0.25)
    # Without a name they are as late as they are stamped.
    assert [found.selector.start[late] for found in (plain, moved)] == pytest.approx([0.0, 0.0], abs=1e-15)


@pytest.mark.thorough
def test_wheels_with_a_term_that_has_no_name_have_it_found_with_its_number():
    line = wheels_of(lambda u: -0.02 * u * np.abs(u), drive=DRIVE * 2)
    found = found_on(line)
    assert found.names == ()
    (one,) = found.unnamed
    assert one.form.endswith(" u |u|")
    assert found.fit.vector[-1] == pytest.approx(-0.02, rel=0.05)
    assert one.term.model_name == "command += k u |u|"


def test_what_slips_is_named_and_the_rest_is_the_noise_of_the_poses():
    channel, line = body_channel(turn_slip=0.08, drive=DRIVE * 2)
    found = search_body(line, channel.neutral)
    assert found.names == ("turn_slip",)
    assert not found.unnamed
    assert not found.either
    assert found.channel.noise.position_m == pytest.approx(NOISE.position_m, rel=0.1)
    assert found.channel.noise.yaw_rad == pytest.approx(NOISE.yaw_rad, rel=0.1)
    assert found.base.cost > 1.3 * found.fit.cost
    assert found.richest.shape == found.fit.residual.shape
    assert found.richest @ found.richest == pytest.approx(2.0 * found.fit.cost, rel=0.03)
    # The geometry, all that is smooth, every term of the motion and the disc of the floor that promises most.
    terms = sum(len(term.features) for term in body_terms(found.channel, found.channel.neutral))
    smooth = len(indices(found.channel, smooth_of(BODY)))
    assert found.richest_parameters in (smooth + terms, smooth + terms + 1)


def late_by(late_s):
    """A drive of a robot as drawn, whose poses are stamped late."""
    channel, line = body_channel()
    track = channel.track(channel.neutral)
    late = np.clip(line.pose.node - round(late_s / GRID_STEP_S), 0, len(track) - 1)
    return replace(line, pose_values=track[late] + (line.pose_values - track[line.pose.node]))


@pytest.mark.thorough
def test_poses_that_are_late_at_first_sight_are_named_late_and_their_noise_is_not_that_of_slip():
    found = search_body(replace(late_by(0.3), pose_delay_s=0.28), vector_of())
    assert found.names == ("pose_latency",)
    assert found.fit.vector[BODY.place["pose_latency.latency_s"]] == pytest.approx(0.3, abs=0.005)
    assert found.channel.noise.position_m == pytest.approx(NOISE.position_m, rel=0.15)


@pytest.mark.parametrize(
    ("late_s", "seen_s", "moved_s", "begun_s"),
    [
        (0.3, 0.28, 0.0, 0.28),
        (0.0, 0.28, 0.0, 0.0),
        (0.0, 0.003, 0.0, 0.003),
        # Laid too early by what first sight errs by, they are true later than they lie.
        (-0.28, 0.28, 0.28, -0.28),
    ],
)
def test_the_first_noise_is_of_poses_as_late_as_at_first_sight_unless_that_errs(
    monkeypatch, late_s, seen_s, moved_s, begun_s
):
    def begin(of, vector, **_):
        raise RuntimeError(vector[BODY.place["pose_latency.latency_s"]])

    monkeypatch.setattr(channel_search, "learn_body_noise", begin)
    with pytest.raises(RuntimeError) as begun:
        search_body(replace(late_by(late_s), pose_delay_s=seen_s, poses_moved_s=moved_s), vector_of())
    assert begun.value.args == (begun_s,)


@pytest.mark.thorough
def test_what_a_model_knows_of_the_body_is_refitted_and_not_found():
    _, line = body_channel(turn_slip=0.08)
    found = search_body(line, vector_of(turn_slip=0.05), ("turn_slip",))
    assert found.names == found.selector.given == ("turn_slip",)
    assert found.base.vector[BODY.place["turn_slip.k_s"]] == pytest.approx(0.08, abs=0.004)


def test_a_body_with_a_term_that_has_no_name_has_it_found_with_its_number():
    channel, line = body_channel(drive=DRIVE)
    speed, p = line.speed_rad_s, channel.neutral
    v = 0.5 * p[0] * speed.sum(axis=1)
    extra = np.zeros((v.size, 3))
    extra[:, 0] = -0.8 * v**3
    found = search_body(moved_by(channel, extra).drive, p)
    (one,) = found.unnamed
    assert one.term.model_name == "v_x += k v^3"
    # Of the speed that wheels of another radius make.
    expected = -0.8 * (GEOMETRY[0] / one.term.geometry[0]) ** 3
    assert found.fit.vector[-1] == pytest.approx(expected, rel=0.1)


@pytest.fixture
def noted(monkeypatch):
    """What a search makes: its selectors, the entries that its fits free, and of what it takes the noise's tails."""
    selectors, freed, tails = [], [], []

    def note(name, to, told):
        made = getattr(channel_search, name)

        def noting(*arguments, **named):
            result = made(*arguments, **named)
            to.append(told(result, arguments))
            return result

        monkeypatch.setattr(channel_search, name, noting)

    note("Selector", selectors, lambda result, arguments: result)
    note("fit", freed, lambda result, arguments: arguments[2])
    note("_thresholds", tails, lambda result, arguments: (*arguments, result))
    return SimpleNamespace(selectors=selectors, freed=freed, tails=tails)


def of_rough_and_smooth(found, noted, layout):
    """The selector that chose, after a rough one, whose noise is learnt with all that is smooth."""
    rough, chosen, *trials = noted.selectors
    settings = DEFAULT_SETTINGS.selection
    # What moves no prediction would pass for noise too.
    assert (rough.thresholds.score, rough.thresholds.moves_m, rough.closely) == (settings.unnamed_score, 0.0, True)
    assert found.selector.channel is found.channel
    # Of the wheels the same, but for where commands are stamped.
    assert chosen.channel.gains is found.channel.gains
    assert chosen.channel.weight is found.channel.weight
    assert chosen.thresholds is found.selector.thresholds
    assert (chosen.thresholds.moves_m, chosen.closely) == (settings.least_moved_m, False)
    assert all(len(set(active)) == len(active) for active in noted.freed)
    assert set(indices(found.channel, smooth_of(layout))) in [set(active) for active in noted.freed]
    # What comes after tries terms one by one, of which none is worth it.
    assert len(trials) <= DEFAULT_SETTINGS.terms.most_tried
    assert all(isinstance(trial.channel, WithTerms) and len(trial.channel.terms) == 1 for trial in trials)
    assert not found.unnamed
    return chosen


def test_the_noise_of_wheels_is_learnt_of_a_rough_selection_and_all_that_is_smooth(noted):
    found = found_on(wheels_of(motor_lag=0.15, drive=((0, 4), (3, 3), (0, 0)) * 6))
    chosen = of_rough_and_smooth(found, noted, WHEEL)
    settings = DEFAULT_SETTINGS.selection
    # Heavy tails are those of wheels of which one turns at least.
    ((white, use, of, limits),) = noted.tails
    turning = (
        np.abs(found.channel.drive.speed_rad_s[found.channel.drive.encoder.node]) > DEFAULT_SETTINGS.grid.rest_rad_s
    )
    np.testing.assert_array_equal(use, found.channel.gains.use & turning.any(axis=1))
    assert turning.any(axis=1).mean() > turning.all(axis=1).mean() + 0.2
    np.testing.assert_array_equal((white * found.channel.weight).ravel(), found.richest)
    assert of is settings
    assert limits is chosen.thresholds


@pytest.mark.thorough
def test_where_nothing_that_is_known_comes_near_the_noise_is_what_that_leaves(noted, monkeypatch):
    drive = ((4, 4), (-3, 3), (0, 0), (2, 5)) * 5
    # No stretch is weighed down by the same number.
    monkeypatch.setattr("disco_hw.gap.noise.local_weight", lambda white, use, settings: np.ones(white.shape))

    def searched(poor_fit):
        choice = replace(DEFAULT_SETTINGS.noise, poor_fit=poor_fit)
        line = wheels_of(drive=drive, settings=replace(DEFAULT_SETTINGS, noise=choice), motor_lag=0.15)
        noted.selectors.clear()
        return found_on(line), len(noted.selectors)

    near, selectors = searched(1e9)
    assert selectors == 2
    # Half a square each is expected of what the richest model leaves as noise.
    times = near.fit.cost / (0.5 * near.channel.count)
    again, selectors = searched(1.01 * times)
    assert selectors == 2
    assert again.channel.noise == near.channel.noise
    plainer, selectors = searched(0.99 * times)
    assert selectors == 3
    assert plainer.channel.noise != near.channel.noise
    assert plainer.richest_parameters == near.richest_parameters
    assert plainer.names == ("motor_lag",)


@pytest.mark.thorough
def test_the_noise_of_a_body_is_learnt_of_a_rough_selection_and_all_that_is_smooth(noted):
    channel, line = body_channel(turn_slip=0.08)
    found = search_body(line, channel.neutral)
    chosen = of_rough_and_smooth(found, noted, BODY)
    settings = DEFAULT_SETTINGS.selection
    ((white, use, of, limits),) = noted.tails
    assert use is found.channel.use
    np.testing.assert_array_equal((white * found.channel.weight).ravel(), found.richest)
    assert of is settings
    assert limits is chosen.thresholds


LATE_PLACES = [WHEEL.place[column] for column in DELAY_COLUMNS]


def begun(names, given=(), before=None, best=0, seen_s=0.0):
    """Vectors from which `responding` fits lateness with a stand-in for `fit`, of which one ends best, and its end."""
    drive = SimpleNamespace(commands_moved_s=seen_s)
    channel = SimpleNamespace(layout=WHEEL, free=(), inner=SimpleNamespace(drive=drive))
    selector = Selector(channel, lambda small, big: 0.0, LIMITS, given=given)
    plain = vector_of(WHEEL, deadband=0.4)
    others = tuple(name for name in names if name in given or name not in DELAY_NAMES)
    selector.fits[frozenset(others)] = fit_at(50.0, plain)
    if before is not None:
        selector.fits[frozenset(names)] = before
    starts = []

    def fitted(channel, start, active):
        assert active == indices(channel, names)
        starts.append(start)
        cost = 10.0 if len(starts) - 1 == best else 20.0
        return Fit(start, active, cost, np.empty(0), np.empty((0, 0)))

    return selector, starts, fitted


@pytest.mark.parametrize("seen_s", [0.0, -0.4])
def test_lateness_is_fitted_from_quick_and_slow_responses_after_what_is_seen_at_first_sight(monkeypatch, seen_s):
    selector, starts, fitted = begun((*DELAY_NAMES, "deadband"), best=2, seen_s=seen_s)
    monkeypatch.setattr(channel_search, "fit", fitted)
    responding(selector, (*DELAY_NAMES, "deadband"))
    later = [seen_s * (name == "command_delay") for name in DELAY_NAMES]
    assert [tuple(start[LATE_PLACES]) for start in starts] == [tuple(np.add(each, later)) for each in DELAY_STARTS_S]
    assert {start[WHEEL.place["deadband.width_rad_s"]] for start in starts} == {0.4}
    assert selector.fits[frozenset((*DELAY_NAMES, "deadband"))].vector is starts[2]


def test_lateness_on_top_of_what_was_accepted_is_fitted_from_none(monkeypatch):
    names = (*DELAY_NAMES, "deadband")
    for before_cost, kept in ((5.0, True), (15.0, False)):
        before = fit_at(before_cost, WHEEL.neutral)
        selector, starts, fitted = begun(names, before=before)
        monkeypatch.setattr(channel_search, "fit", fitted)
        responding(selector, names)
        assert [tuple(start[LATE_PLACES]) for start in starts] == [(0.0, 0.0)]
        assert (selector.fits[frozenset(names)] is before) is kept


def test_lateness_that_is_known_already_is_fitted_from_these_too(monkeypatch):
    selector, starts, fitted = begun(DELAY_NAMES, given=("motor_lag",))
    monkeypatch.setattr(channel_search, "fit", fitted)
    responding(selector, DELAY_NAMES)
    assert [tuple(start[LATE_PLACES]) for start in starts] == list(DELAY_STARTS_S)


def test_a_result_has_the_fits_with_and_without_what_is_missing_and_of_a_search_with_terms_those_before():
    def selector(given):
        return SimpleNamespace(given=given, exact=lambda names: (given, names))

    found = ChannelResult(selector(("slope",)), ("slope", "turn_slip"), None)
    assert found.fit == (("slope",), ("slope", "turn_slip"))
    assert found.base == (("slope",), ("slope",))
    extended = replace(found, plain=selector(()))
    assert extended.fit == found.fit
    assert extended.base == ((), ())
    assert found.richest_parameters == 0


def test_every_set_has_the_delay_that_is_seen_at_first_sight_until_it_is_judged_itself():
    line = replace(line_of(np.tile([2.0, 3.0], (800, 1))), commands_moved_s=0.2)
    channel = wheels_on(line)
    start, moved = vector_of(WHEEL, wheel_gain__left=0.1), np.zeros(WHEEL.neutral.size)
    moved[WHEEL.place["command_delay.delay_s"]] = 0.2
    for given, begin, expected in ((("wheel_gain",), start, start + moved), ((), None, WHEEL.neutral + moved)):
        selector = Selector(channel, None, LIMITS, given=given, start=begin, fits={frozenset(): 1}, proofs={(): 2})
        late = timed(selector)
        assert late.given == (*given, "command_delay")
        np.testing.assert_array_equal(late.start, expected)
        assert (late.fits, late.proofs) == ({}, {})


def test_wheels_are_searched_as_if_commands_were_stamped_where_they_lie(monkeypatch):
    drives = []

    def build(drive, noise, geometry):
        drives.append(drive)
        raise InterruptedError

    monkeypatch.setattr(channel_search, "WheelChannel", SimpleNamespace(build=build))
    line = replace(line_of(np.tile([2.0, 3.0], (80, 1))), commands_moved_s=0.2)
    with pytest.raises(InterruptedError):
        found_on(line)
    assert [drive.commands_moved_s for drive in drives] == [0.0]


def test_delays_are_told_from_the_stamps_of_commands_with_where_fits_begin():
    line = line_of(np.tile([2.0, 3.0], (80, 1)))
    channel = wheels_on(line)
    moved = np.where([column == "command_delay.delay_s" for column in WHEEL.columns], 0.2, 0.0)
    for start, expected in ((WHEEL.neutral, WHEEL.neutral + moved), (None, None)):
        found = ChannelResult(Selector(channel, None, LIMITS, start=start), (), channel)
        later = stamped(found, replace(line, commands_moved_s=0.2)).selector.start
        assert later is expected is None or (later == expected).all()


@dataclass(frozen=True)
class Held:
    """Stands for a selector: what it takes for needed and swaps, and among what, is seen in the names."""

    channel: object
    given: tuple
    start: object
    fits: dict
    proofs: dict

    def needed(self, names, among):
        return (*names, f"needed of {among}")

    def swapped(self, names, among):
        return (*names, f"swapped of {among}")


def test_a_delay_alone_is_judged_against_none_and_fits_that_have_it_stay():
    sets = [frozenset(names) for names in ((), ("command_delay",), ("command_delay", "deadband"), ("deadband",))]
    selector = Held(SimpleNamespace(layout=WHEEL), ("command_delay",), None, dict.fromkeys(sets, "fit"), {1: 2})
    start = WHEEL.neutral
    found = evaluated_channel(ChannelResult(selector, ("deadband",), None), (), start)
    of, late = "of ('command_delay',)", "of ('motor_lag', 'command_delay')"
    assert found.names == ("deadband", f"needed {of}", f"swapped {late}", f"needed {of}")
    assert set(found.selector.fits) == {sets[1], sets[2]}
    assert (found.selector.given, found.selector.start, found.selector.proofs) == ((), start, {})
    assert found.plain is None
