"""Intervals, profiles and what the parts of a log say of a value, each against what is computed by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.search import channel_result
from disco_hw.gap.search.channel_result import InParts, drifted, estimate_parameters, in_equal_parts, in_logs, in_parts
from disco_hw.gap.search.least_squares import Fit, fit
from disco_hw.gap.settings import DEFAULT_SETTINGS, FitSettings, GapSettings
from tests.gap.synthetic import GEOMETRY, body_on, line_of, poses_of, vector_of, wheels_on


@pytest.mark.parametrize(("begins_s", "drives"), [((0.0,), 2.0), ((0.0, 30.0, 60.0), 4.0)])
def test_an_interval_is_of_another_drive_and_widened_by_how_a_value_wanders(monkeypatch, begins_s, drives):
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    reported = SimpleNamespace(vector=np.array([7.0, 5.0, 3.0]), active=(2, 0), covariance=lambda: covariance)
    low, high = np.array([-60.0, 0.0, -np.inf]), np.array([60.0, 1.0, np.inf])
    layout = SimpleNamespace(columns=("a", "b", "c"), low=low, high=high)
    channel = SimpleNamespace(layout=layout, inner=SimpleNamespace(drive=SimpleNamespace(log_begins_s=begins_s)))
    found = SimpleNamespace(reported=reported, selector=SimpleNamespace(channel=channel), names=())
    monkeypatch.setattr(channel_result, "interval_inflation", lambda best, of, active: {2: 4.0, 0: 1.44}[active[0]])
    monkeypatch.setattr(channel_result, "drifted", lambda of: {"c": 6.0})
    monkeypatch.setattr(channel_result, "_weightings_apart", lambda of: np.array([3.0, 0.0]))
    monkeypatch.setattr(channel_result, "_stamped", lambda of: {"a": 2.0})
    monkeypatch.setattr(channel_result, "_hidden_sensor_errors", lambda of: np.array([1.0, 5.0]))
    estimates = estimate_parameters(found)
    # Of `c` 4 x 4 for each drive and 10 beside, of `a` 9 x 1.44 and 7 beside.
    variances = np.array([16.0 * drives + 10.0, 12.96 * drives + 7.0])
    deviations = np.sqrt(variances)
    # The correlation is that of the fit, 1 / 6.
    together = deviations.prod() / 6.0
    np.testing.assert_allclose(estimates.covariance, [[variances[0], together], [together, variances[1]]])
    assert estimates.fitted == ("c", "a")
    for name, value, deviation in (("c", 3.0, deviations[0]), ("a", 7.0, deviations[1])):
        one = estimates.by_name[name]
        assert (one.value, one.low, one.high) == pytest.approx(
            (value, value - 1.96 * deviation, value + 1.96 * deviation)
        )
    # Of what a log says nothing the range is known.
    layout.low, layout.high = np.array([-1.0, 0.0, -0.5]), np.array([2.0, 1.0, 1.0])
    spread = [float(np.std(np.random.default_rng(0).uniform(0.0, width, 100_000))) for width in (1.5, 3.0)]
    narrow = estimate_parameters(found)
    assert [narrow.by_name[name].deviation for name in ("c", "a")] == pytest.approx(spread, rel=0.01)
    np.testing.assert_allclose(np.sqrt(np.diag(narrow.covariance)), spread, rtol=0.01)
    np.testing.assert_allclose(correlation(narrow.covariance), correlation(estimates.covariance))


def correlation(covariance):
    return covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])


def test_two_weightings_lie_apart_by_what_is_beyond_the_difference_of_their_variances(monkeypatch):
    reported = SimpleNamespace(active=(2, 0, 1), vector=np.array([1.0, 2.0, 3.0]))
    evenly = SimpleNamespace(active=(2, 0, 1), vector=np.array([2.0, 0.0, 7.0]))
    deviations = {id(evenly): np.array([3.0, 1.0, 1.0]), id(reported): np.array([2.0, 2.0, 1.0])}
    monkeypatch.setattr(channel_result, "deviations_of", lambda best, channel: deviations[id(best)])
    found = SimpleNamespace(reported=reported, fit=reported, evenly=evenly, channel=None)
    # Half of 16 beyond 9 - 4, of 1 within 4 - 1, and of 4 beyond none.
    assert channel_result._weightings_apart(found).tolist() == [5.5, 0.0, 2.0]
    assert channel_result._weightings_apart(SimpleNamespace(reported=reported, evenly=None)).tolist() == [0.0] * 3


def turned_sensor(commands):
    """What is found of a robot whose sensor is mounted turned by 20 mrad, which is not named, on a drive of a minute.

    And how far its centre of turning is found from where it is (m).
    """
    line = line_of(np.repeat(np.array(commands, dtype=float), 6000 // len(commands), axis=0))
    channel = body_on(line, np.add(poses_of(line, vector_of(), seed=3), (0.0, 0.0, 0.02)))
    best = fit(channel, channel.neutral, channel.free)
    found = SimpleNamespace(reported=best, names=(), selector=SimpleNamespace(channel=channel))
    return found, best.vector[2] - GEOMETRY[2]


def test_on_a_circle_the_centre_of_turning_is_as_uncertain_as_how_the_sensor_is_mounted():
    ahead = BODY.columns.index("x_icr_m")
    found, off_m = turned_sensor([(2.0, 5.0)])
    # The circle's radius is 0.21 m/s over 0.45 rad/s, and sensors are turned by 26 mrad.
    assert abs(off_m) == pytest.approx(0.467 * 0.02, abs=0.002)
    added = channel_result._hidden_sensor_errors(found)
    assert added[found.reported.active.index(ahead)] ** 0.5 == pytest.approx(0.467 * 0.026, rel=0.1)
    # Straight ahead only the sensor can move it aside.
    found, off_m = turned_sensor([(4.0, 4.0), (-3.0, 3.0), (5.0, 5.0), (3.0, -3.0), (2.0, 5.0), (5.0, 2.0)])
    assert abs(off_m) < 0.004
    added = channel_result._hidden_sensor_errors(found)
    assert added[found.reported.active.index(ahead)] ** 0.5 < 0.002
    # Of wheels no pose is asked.
    wheels = wheels_on(line_of(np.ones((600, 2))))
    alone = SimpleNamespace(names=(), reported=SimpleNamespace(active=(1, 2)), selector=SimpleNamespace(channel=wheels))
    assert channel_result._hidden_sensor_errors(alone).tolist() == [0.0, 0.0]


def test_a_delay_is_known_as_well_as_the_stamps_are():
    drive = SimpleNamespace(command_stamps_s=0.02, pose_stamps_s=0.03)
    for layout, column, variance in ((WHEEL, "command_delay.delay_s", 4e-4), (BODY, "pose_latency.latency_s", 9e-4)):
        channel = SimpleNamespace(layout=layout, inner=SimpleNamespace(drive=drive))
        of_delays = channel_result._stamped(SimpleNamespace(selector=SimpleNamespace(channel=channel)))
        assert of_delays == {column: pytest.approx(variance)}


@pytest.mark.parametrize("step", [0.5, 2.0])
@pytest.mark.parametrize(
    ("slope", "ends"), [(1e3, (-4.0, 128.0)), (0.392, (-(200.0**0.5), 128.0)), (0.01, (-554.372, 554.372))]
)
@pytest.mark.parametrize("precision", [None, np.array([3.0])])
def test_a_profile_reaches_to_where_the_cost_has_risen_or_blocks_scatter(monkeypatch, step, slope, ends, precision):
    # Below, the cost rises by 1.91 nats within two steps and by 1.93 within four; above it never does.
    def at(steps):
        cost = 5.0 + {-1.0: 0.5, -2.0: 1.91, -4.0: 1.93}.get(steps, 0.0)
        residual = np.array([0.0, slope * steps])
        return Fit(np.array([3.0, 10.0 + step * steps]), (0,), cost, residual, np.array([[1.0], [0.0]]), precision)

    def fit(channel, vector, active, iterations):
        assert (active, iterations, vector[0]) == (("freed",), 1, 3.0)
        return at((vector[1] - 10.0) / step)

    monkeypatch.setattr(channel_result, "fit", fit)
    monkeypatch.setattr(channel_result, "indices", lambda channel, names: ("freed",))
    monkeypatch.setattr(
        channel_result, "interval_inflation", lambda free, channel, of: {((0, 1), (1,)): 4.0}[free.active, of]
    )
    inner = SimpleNamespace(drive=SimpleNamespace(log_begins_s=(0.0,)))
    channel = SimpleNamespace(layout=SimpleNamespace(place={"x.at": 1}), inner=inner)
    found = SimpleNamespace(selector=SimpleNamespace(channel=channel), fit=at(0.0), names=())
    one = channel_result._profiled(found, "x.at", step)
    # Twice as far each time, beyond 64 steps no more; or 1.96 deviations of the difference to
    # another drive; those of either are twice those of the noise model.
    assert (one.low, one.value, one.high) == pytest.approx((10.0 + ends[0] * step, 10.0, 10.0 + ends[1] * step))


def of_blocks(block, reported=None, settings=DEFAULT_SETTINGS):
    layout = SimpleNamespace(columns=("x",), low=np.array([-np.inf]), high=np.array([np.inf]))
    channel = SimpleNamespace(block=np.asarray(block), settings=settings, layout=layout)
    return SimpleNamespace(reported=reported, channel=channel, selector=SimpleNamespace(channel=channel))


def test_a_value_wanders_by_what_halves_surely_differ_or_by_the_most_that_shorter_parts_do(monkeypatch):
    # Halves that lie 3.1 and 2.9 of their deviations apart.
    sure, unsure = (InParts(np.array([0.0, of * 2.0**0.5]), np.ones(2)) for of in (-3.1, 2.9))
    quarters = InParts(np.array([0.0, 4.0, 0.0, 4.0]), np.ones(4))
    alike = InParts(np.array([0.0, 0.5]), np.full(2, 0.1))
    shown = {2: {"sure": sure, "unsure": unsure, "both": sure}, 4: dict.fromkeys(("both", "short"), quarters)}
    shown[4]["little"] = alike
    monkeypatch.setattr(channel_result, "in_equal_parts", lambda found, count: shown[count])
    logs: dict[str, InParts] = {}
    monkeypatch.setattr(channel_result, "in_logs", lambda found: logs)
    # Squares of half their distance, twice, less one expected.
    of_sure, of_unsure = 3.1**2 - 1.0, 2.9**2 - 1.0
    told = drifted(of_blocks(np.arange(12)))
    assert told == {
        "sure": pytest.approx(4.0 * of_sure), "unsure": pytest.approx(of_unsure), "both": pytest.approx(4.0 * of_sure),
        "short": pytest.approx((16.0 - 3.0) / 3.0), "little": pytest.approx(0.125 - 0.01),
    }  # fmt: skip
    # What goes on from drive to drive is seen in halves alone.
    shown[2] = {"short": unsure}
    assert drifted(of_blocks(np.arange(12)))["short"] == pytest.approx(of_unsure)
    # And by what logs differ, where that is more.
    logs |= {"short": quarters, "new": quarters, "slight": alike}
    most = {"short": of_unsure, "new": 13.0 / 3.0, "slight": 0.125 - 0.01}
    told = drifted(of_blocks(np.arange(12)))
    assert {name: told[name] for name in most} == pytest.approx(most)
    logs["short"] = InParts(np.array([0.0, 5.0]), np.ones(2))
    assert drifted(of_blocks(np.arange(12)))["short"] == pytest.approx(12.5 - 1.0)


def test_parts_of_a_log_are_as_long_as_each_other(monkeypatch):
    monkeypatch.setattr(channel_result, "in_parts", lambda found, of: of.tolist())
    # Eight blocks with something in them.
    assert in_equal_parts(of_blocks([0, 0, 1, 3, 4, 4, 5, 6, 8, 9]), 2) == [0, 0, 0, 0, 1, 1, 1, 1]
    assert in_equal_parts(of_blocks(np.arange(8)), 3) == [0, 0, 0, 1, 1, 1, 2, 2]


def test_a_block_belongs_to_the_log_in_which_it_ends(monkeypatch):
    monkeypatch.setattr(channel_result, "in_parts", lambda found, of, some: (some, of.tolist()))

    def labels(blocks, *begins_s):
        found = of_blocks(blocks)
        found.channel.inner = SimpleNamespace(drive=SimpleNamespace(log_begins_s=begins_s))
        return in_logs(found)

    # Blocks of 3 s.
    assert labels(np.arange(12), 0.0, 30.0) == (True, [1] * 10 + [2] * 2)
    assert labels(np.arange(4), 0.0, 8.9) == (True, [1, 1, 2, 2])


def scattered(share, seed=0):
    """Twelve blocks of one residual each, of whose information the first half holds this share."""
    rng = np.random.default_rng(seed)
    squares = np.repeat([share / 6.0, (1.0 - share) / 6.0], 6)
    slope, residual = np.sqrt(squares)[:, None], 3.0 * rng.standard_normal(12)
    return slope, residual, Fit(np.array([2.0]), (0,), 0.0, residual, slope)


@pytest.mark.parametrize(("share", "known"), [(0.11, True), (0.09, False)])
def test_a_part_that_says_less_than_its_share_of_a_value_says_nothing(share, known):
    settings = GapSettings(fit=FitSettings(part_known_share=0.2))
    found = of_blocks(np.arange(12), scattered(share)[2], settings)
    assert bool(in_parts(found, np.repeat([0, 1], 6))) is known


def test_of_several_logs_those_that_say_enough_speak_where_there_are_two():
    found = of_blocks(np.arange(12), scattered(0.02)[2])
    assert in_parts(found, np.repeat([0, 1], 6), some=True) == {}
    # The first third says next to nothing, and the others are as they are beside one that is known.
    thirds = np.repeat([0, 1, 2], (6, 3, 3))
    assert in_parts(found, thirds) == {}
    two = in_parts(found, thirds, some=True)["x"]
    alone = in_parts(of_blocks(np.arange(6), later(found.reported)), np.repeat([0, 1], 3))["x"]
    np.testing.assert_allclose((two.values, two.deviations), (alone.values, alone.deviations))


def later(fitted):
    """The second half of a fit."""
    return replace(fitted, residual=fitted.residual[6:], slope=fitted.slope[6:])


def test_of_one_part_nothing_is_said_apart():
    assert in_parts(of_blocks(np.arange(12), scattered(0.5)[2]), np.zeros(12, dtype=np.int64)) == {}
    nothing = Fit(np.array([2.0]), (), 0.0, np.ones(12), np.empty((12, 0)))
    assert in_parts(of_blocks(np.arange(12), nothing), np.repeat([0, 1], 6)) == {}


def test_a_part_says_a_value_as_surely_as_the_noise_model_or_its_own_blocks_three_by_three_have_it():
    slope, residual, told = scattered(0.4)
    one = in_parts(of_blocks(np.arange(12), told), np.repeat([0, 1], 6))["x"]
    for part, rows in enumerate((slice(0, 6), slice(6, 12))):
        a, r = slope[rows, 0], residual[rows]
        variance = 1.0 / (a @ a)
        step = -variance * (a @ r)
        by_threes = (variance * a * (r + a * step)).reshape(2, 3).sum(axis=1)
        assert one.values[part] == pytest.approx(2.0 + step)
        assert one.deviations[part] ** 2 == pytest.approx(max(variance, (by_threes**2).sum()))
    # The residuals are three times what is expected: blocks say less than the noise model in one half at least.
    assert max(one.deviations**2 * [0.4, 0.6]) > 1.5
