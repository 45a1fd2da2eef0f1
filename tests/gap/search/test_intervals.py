"""95 % intervals hold what is true about as often as they say, and are wider where the noise is more than thought."""

from dataclasses import replace
from itertools import permutations
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from disco_hw.gap.data import WHEEL
from disco_hw.gap.noise.wheel_noise import WheelNoise
from disco_hw.gap.report.judge import across_logs, drifting_parameters
from disco_hw.gap.search.analysis import GapAnalysis, final_fit, in_motion
from disco_hw.gap.search.channel_result import (
    ChannelEstimates,
    InParts,
    ParameterEstimate,
    deviations_of,
    estimate_parameters,
    in_equal_parts,
    in_logs,
)
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S
from tests.gap.synthetic import DRIVE, body_channel, body_on, line_of, poses_of, searched, vector_of, wheels_on


def estimated(channel, names=("turn_slip",)):
    return estimate_parameters(searched(channel, names))


TRUTH = {"turn_slip.k_s": 0.08, "wheel_radius_m": 0.06, "axial_distance_m": 0.4}


@pytest.fixture(scope="module")
def twelve():
    """What twelve drives of one robot say of its parameters."""
    return [estimated(body_channel(seed, turn_slip=0.08)[0]).by_name for seed in range(12)]


def test_intervals_hold_the_truth_nine_times_of_ten(twelve):
    held = [found[name].low <= truth <= found[name].high for found in twelve for name, truth in TRUTH.items()]
    assert np.mean(held) >= 0.85


def test_intervals_hold_what_another_drive_gives(twelve):
    """The promise of the report, which no error of the other drive is added to."""
    held = []
    for here, there in permutations(twelve, 2):
        held += [here[name].low <= there[name].value <= here[name].high for name in TRUTH]
    assert 0.95 <= np.mean(held) <= 0.995


def test_the_time_of_a_change_has_an_interval_around_it():
    channel, _ = body_channel()
    vector = vector_of(surface_change__track=0.12, surface_change__time_s=35.0)
    moved = channel.measured + (channel.track(vector) - channel.track(channel.neutral))[channel.samples.node]
    found = estimated(body_on(channel.drive, moved), ("surface_change",))
    time = found.by_name["surface_change.time_s"]
    assert time.low < time.value < time.high
    assert time.value == pytest.approx(35.0, abs=1.0)
    assert time.high - time.low < 10.0


def test_a_limit_of_turning_is_no_better_known_than_the_geometry_that_it_is_told_in():
    def estimates_of(covariance, **values):
        ends = [1.96 * spread for spread in np.sqrt(np.diag(covariance))]
        by_name = {
            name: ParameterEstimate(v, v - end, v + end) for (name, v), end in zip(values.items(), ends, strict=True)
        }
        return ChannelEstimates(by_name, tuple(values), np.asarray(covariance))

    limit, lag = "yaw_rate_limit.limit_rad_s", "motor_lag.tau_s"
    # Radius and axial distance are known to 1 % and 2 %, and their ratio to sqrt(1 + 4 - 2 * 1.5) %.
    geometry = estimates_of([[0.0006**2, 3.6e-6], [3.6e-6, 0.008**2]], wheel_radius_m=0.06, axial_distance_m=0.4)
    wheels = estimates_of([[0.01**2, 1e-6], [1e-6, 0.001**2]], **{limit: 1.0, lag: 0.1})
    found = in_motion(wheels, geometry)
    assert found.by_name[limit].deviation == pytest.approx(np.hypot(0.01, 0.02**0.5 / 10.0))
    assert found.by_name[limit].value == 1.0
    assert found.by_name[lag] == wheels.by_name[lag]
    assert found.covariance[0, 0] == pytest.approx(found.by_name[limit].deviation ** 2)
    np.testing.assert_array_equal(found.covariance.ravel()[1:], wheels.covariance.ravel()[1:])


def changing(late_k_s):
    """A drive whose turn slip is 0.08 in the first half and another later."""
    _, line = body_channel(turn_slip=0.08)
    _, changed = body_channel(turn_slip=late_k_s)
    second = line.pose.t_s > line.t_s[-1] / 2.0
    return body_on(line, np.where(second[:, None], changed.pose_values, line.pose_values))


def of_two_logs(channel):
    """The same, as if its halves were logs that are searched together."""
    return replace(channel, drive=replace(channel.drive, log_begins_s=(0.0, 0.5 * channel.drive.duration_s)))


def test_halves_that_disagree_widen_the_interval_to_hold_both():
    same, drifting = changing(0.08), changing(0.16)
    found = [estimated(one).by_name["turn_slip.k_s"] for one in (same, drifting)]
    early, late = in_equal_parts(searched(drifting, ("turn_slip",)), 2)["turn_slip.k_s"].values
    assert (early, late) == pytest.approx((0.08, 0.16), abs=0.03)
    assert found[1].low < early < late < found[1].high
    assert found[0].deviation < 0.3 * found[1].deviation


def test_what_wanders_is_told_from_what_parts_know_badly():
    wide, narrow = (InParts(np.array([1.0, 3.0]), np.full(2, deviation)) for deviation in (2.0, 0.1))
    assert wide.variance_between == 0.0
    # Half the squared difference, less the mean variance of the two.
    assert narrow.variance_between == pytest.approx(2.0 - 0.01)
    assert narrow.apart(0, 1) == pytest.approx(2.0 / (0.1 * 2.0**0.5))
    assert narrow.apart(1, 0) == -narrow.apart(0, 1)
    # A part that knows little weighs little.
    assert InParts(np.array([1.0, 1.0, 9.0]), np.array([0.1, 0.1, 8.0])).variance_between == 0.0


@pytest.mark.parametrize("parts", [2, 4, 8])
def test_what_wanders_at_random_is_expected_as_far_off_in_the_next_log_as_it_is(parts):
    steps = np.random.default_rng(parts).standard_normal((4000, 2 * 400))
    this, following = np.split(np.cumsum(steps, axis=1), 2, axis=1)
    means = this.reshape(4000, parts, -1).mean(axis=2)
    expected = np.mean([InParts(each, np.full(parts, 1e-3)).variance_to_next for each in means])
    assert expected == pytest.approx(np.mean((following.mean(axis=1) - this.mean(axis=1)) ** 2), rel=0.08)


def test_a_part_that_cannot_tell_two_parameters_apart_says_nothing_of_either():
    """On a circle a longer axle is as good as slip."""
    rich = 2 * DRIVE
    line = line_of(np.repeat(np.array([(3, 5)] * len(rich) + list(rich), dtype=float), 200, axis=0))
    channel = body_on(line, poses_of(line, vector_of(turn_slip=0.08), seed=4))
    result = searched(channel, ("turn_slip",))
    found = in_equal_parts(result, 2)
    assert "turn_slip.k_s" not in found
    assert "axial_distance_m" not in found
    assert found["x_icr_m"].values == pytest.approx([vector_of()[2]] * 2, abs=0.005)
    # Of three logs, of which the first is such a circle, the two others speak.
    quarter_s = 0.25 * channel.drive.duration_s
    three = replace(channel, drive=replace(channel.drive, log_begins_s=(0.0, 2.0 * quarter_s, 3.0 * quarter_s)))
    found = in_logs(searched(three, ("turn_slip",)))
    assert found["turn_slip.k_s"].values == pytest.approx((0.08, 0.08), abs=0.03)
    assert found["x_icr_m"].values.size == 3


def test_each_of_several_logs_speaks_for_itself():
    result = searched(of_two_logs(changing(0.16)), ("turn_slip",))
    found = in_logs(result)
    assert found["turn_slip.k_s"].values == pytest.approx((0.08, 0.16), abs=0.03)
    assert found["turn_slip.k_s"].apart(0, 1) > 3.0
    assert abs(found["wheel_radius_m"].apart(0, 1)) < 3.0
    assert in_logs(searched(changing(0.16), ("turn_slip",))) == {}
    assert in_equal_parts(result, 3)["turn_slip.k_s"].values.size == 3


def test_a_parameter_that_changes_along_a_log_is_said_to_drift_and_another_is_not():
    for channel, drifts in ((changing(0.08), False), (changing(0.16), True)):
        result = searched(channel, ("turn_slip",))
        analysis = GapAnalysis(channel.drive, channel.neutral, WHEEL.neutral, result, None)
        said = drifting_parameters(analysis, final_fit(analysis))
        assert bool(said) == drifts
        assert not drifts or said[0].startswith("turn_slip.k_s drifts: 0.0")


@pytest.mark.parametrize(
    ("thirds", "halves", "said"),
    [
        ([1.0, 1.1, 1.2], [1.0, 1.2], "1 in the first third of the log, 1.1 in the second, 1.2 in the last"),
        ([1.2, 1.1, 1.0], None, "1.2 in the first third of the log, 1.1 in the second, 1 in the last"),
        (None, [1.0, 1.2], "1 in the first half of the log, 1.2 in the second"),
        (None, [1.0, 1.09], None),
        (None, [1.0, 0.885], None),
        ([1.0, 1.3, 1.2], [1.0, 1.2], None),
        (None, None, None),
    ],
)
def test_a_drift_shows_in_thirds_or_where_these_say_too_little_in_halves(monkeypatch, thirds, halves, said):
    def in_equal_parts(found, count):
        values = {2: halves, 3: thirds}[count]
        return {} if values is None else {"lag.s": InParts(np.array(values), np.full(count, 0.03))}

    monkeypatch.setitem(drifting_parameters.__globals__, "in_equal_parts", in_equal_parts)
    analysis = SimpleNamespace(drive=SimpleNamespace(settings=DEFAULT_SETTINGS), body="body", wheels=None)
    found = drifting_parameters(analysis, SimpleNamespace(body_estimates="found", wheel_estimates=None))
    assert found == (() if said is None else (f"lag.s drifts: {said}",))


def test_logs_of_one_robot_differ_in_what_changed_between_them_alone():
    for late_k_s, differs in ((0.08, set()), (0.16, {"turn_slip.k_s"})):
        channel = of_two_logs(changing(late_k_s))
        result = searched(channel, ("turn_slip",))
        analysis = GapAnalysis(channel.drive, channel.neutral, WHEEL.neutral, result, None)
        found = across_logs(analysis)
        assert {each.name for each in found} >= {"turn_slip.k_s", "wheel_radius_m", "x_icr_m"}
        assert {each.name for each in found if each.differs} - {"axial_distance_m"} == differs
        for each in found:
            assert all(low < value < high for value, low, high in each.values)


UNEVEN = WheelNoise(relative=0.015, correlation_s=0.15, stamp_s=1e-6, drift_std=1e-3, drift_rad_sqrt_s=2e-3)


def wheels_that_lose(lost_on_the_spot):
    """What is found of wheels that lose 0.5 rad/s on straights and arcs, and so much on each spot; 1.5 % of noise."""
    rng = np.random.default_rng(12)
    pairs = np.array(20 * [(4, 4), (-4, -4), (3, 5), (-1, 1), (5, 3), (1, -1)], dtype=float)
    commands = rng.permutation(pairs)
    on_the_spot = commands.sum(axis=1) == 0.0
    width = np.full(len(commands), 0.5)
    width[on_the_spot] = lost_on_the_spot(rng, np.count_nonzero(on_the_spot))
    turned = np.repeat(np.sign(commands) * np.maximum(np.abs(commands) - width[:, None], 0.0), 50, axis=0)
    keep = np.exp(-GRID_STEP_S / 0.15)
    error = lfilter([(1.0 - keep**2) ** 0.5], [1.0, -keep], rng.standard_normal(turned.shape), axis=0)
    speed = turned * (1.0 + 0.015 * error) + 0.02 * rng.standard_normal(turned.shape)
    line = replace(line_of(speed), command_rad_s=np.repeat(commands, 50, axis=0))
    return searched(wheels_on(line, UNEVEN), ("deadband",))


def wheels_that_stick(thresholds):
    """What is found of wheels that follow forty ramps from rest, each beyond a threshold."""
    rng = np.random.default_rng(12)
    ramp = np.concatenate([np.linspace(0.0, 1.5, 150), np.zeros(50)])
    command = np.tile(ramp, thresholds.size)[:, None] * (1.0, 1.0)
    turned = np.where(command > np.repeat(thresholds, ramp.size)[:, None], command, 0.0)
    line = replace(line_of(turned + 0.02 * rng.standard_normal(turned.shape)), command_rad_s=command)
    return searched(wheels_on(line, UNEVEN), ("stiction",))


@pytest.mark.parametrize("scatters", [False, True])
def test_a_threshold_is_known_no_better_than_blocks_agree_on_it(monkeypatch, scatters):
    thresholds = np.random.default_rng(1).uniform(0.6, 0.8, 40) if scatters else np.full(40, 0.7)
    found = wheels_that_stick(thresholds)
    wide = estimate_parameters(found).by_name["stiction.threshold_rad_s"]
    assert wide.low < wide.value < wide.high
    assert wide.value == pytest.approx(0.7, abs=0.03)
    monkeypatch.setitem(estimate_parameters.__globals__, "interval_inflation", lambda *of: 1.0)
    plain = estimate_parameters(found).by_name["stiction.threshold_rad_s"]
    assert plain.low < plain.value == wide.value < plain.high
    assert (wide.deviation > 1.2 * plain.deviation) == scatters


def test_where_the_noise_model_holds_its_fit_is_told():
    found = wheels_that_lose(lambda rng, count: np.full(count, 0.5))
    assert found.reported is found.fit
    # Either weighting finds the same.
    estimated = estimate_parameters(found).by_name["deadband.width_rad_s"]
    assert estimated.low < 0.5 < estimated.high
    assert estimated.high - estimated.low < 0.02


def test_where_slow_wheels_contradict_each_other_the_value_of_all_is_told():
    """Errors that are taken to grow with the speed would leave the say to slow wheels, on the spot."""
    found = wheels_that_lose(lambda rng, count: rng.uniform(0.0, 0.5, count))
    place, column = WHEEL.place["deadband.width_rad_s"], "deadband.width_rad_s"
    assert found.fit.vector[place] < 0.4
    assert found.reported.vector[place] == pytest.approx(0.5, abs=0.08)
    estimated = estimate_parameters(found).by_name[column]
    assert estimated.value == found.reported.vector[place]
    assert deviations_of(found.reported, found.channel)[0] < 0.7 * deviations_of(found.fit, found.channel)[0]
    # That slow wheels say otherwise is part of what is not known.
    assert found.reported.vector[place] - found.fit.vector[place] > 2.0 * deviations_of(found.fit, found.channel)[0]
    assert estimated.low < found.fit.vector[place]


def test_errors_that_are_alike_at_every_speed_are_of_the_size_that_is_left():
    found = wheels_that_lose(lambda rng, count: np.full(count, 0.5))
    even = found.channel.evenly(found.fit.vector)
    used = even.gains.use
    white = even.whitened(found.fit.vector)[used]
    # Those of usual size count whole, in units of their root mean square; an outlier grows linearly.
    assert (white**2).mean() ** 0.5 * even.weight[used].max() == pytest.approx(1.0, abs=1e-6)
    counted = np.abs(white * even.weight[used])
    assert counted.max() == pytest.approx(even.settings.noise.even_huber, rel=1e-6)
    assert np.mean(counted < counted.max() - 1e-6) > 0.7
    speed = np.abs(found.channel.motion.speed_rad_s[:, 0])
    slow, fast = speed < 1.0, speed > 3.0
    assert even.gains.scale[slow, 0].mean() == pytest.approx(even.gains.scale[fast, 0].mean(), rel=0.01)
    assert found.channel.gains.scale[slow, 0].mean() > 1.1 * found.channel.gains.scale[fast, 0].mean()
