"""95 % intervals hold what is true about as often as they say, and are wider where the noise is more than thought."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from disco_hw.gap.data import BODY, WHEEL
from disco_hw.gap.report.judge import across_logs, drifting_parameters
from disco_hw.gap.search.analysis import (
    ChannelEstimates,
    GapAnalysis,
    InParts,
    ParameterEstimate,
    estimate_parameters,
    final_fit,
    in_logs,
    in_motion,
    in_thirds,
    wandered,
)
from disco_hw.gap.search.channel_search import ChannelResult, body_moves
from disco_hw.gap.search.selection import Selector
from disco_hw.gap.settings import DEFAULT_SETTINGS
from tests.gap.synthetic import body_channel


def estimated(channel, names=("turn_slip",)):
    return estimate_parameters(ChannelResult(Selector(channel, body_moves(channel)), names, channel))


def test_intervals_hold_the_truth_nine_times_of_ten():
    held = []
    for seed in range(12):
        found = estimated(body_channel(seed, turn_slip=0.08)[0]).by_name
        for name, truth in (("turn_slip.k_s", 0.08), ("wheel_radius_m", 0.06), ("axial_distance_m", 0.4)):
            held.append(found[name].low <= truth <= found[name].high)
    assert np.mean(held) >= 0.85


def test_an_estimate_tells_its_standard_deviation_and_the_joint_one():
    found = estimated(body_channel(turn_slip=0.08)[0])
    place = found.fitted.index("turn_slip.k_s")
    assert found.by_name["turn_slip.k_s"].deviation == pytest.approx(found.covariance[place, place] ** 0.5)
    # More slip and a longer axle both take from turning: what is known is their sum.
    axle = found.fitted.index("axial_distance_m")
    assert found.covariance[place, axle] < 0.0


def test_noise_larger_than_thought_widens_the_interval():
    channel, line = body_channel(turn_slip=0.08)
    wander = 0.05 * np.sin(2.0 * np.pi * channel.samples.t_s[:, None] / (7.0, 11.0, 17.0))
    shaken = type(channel).build(replace(line, pose_values=line.pose_values + wander), channel.noise, channel.neutral)
    found = [estimated(one).by_name["turn_slip.k_s"] for one in (channel, shaken)]
    assert found[1].deviation > 2.0 * found[0].deviation


def test_the_time_of_a_change_has_an_interval_around_it():
    channel, _ = body_channel()
    vector = channel.neutral.copy()
    vector[[BODY.place["surface_change.track"], BODY.place["surface_change.time_s"]]] = 0.12, 35.0
    moved = channel.measured + (channel.track(vector) - channel.track(channel.neutral))[channel.samples.node]
    line = replace(channel.drive, pose_values=moved)
    found = estimated(type(channel).build(line, channel.noise, channel.neutral), ("surface_change",))
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
    channel, line = body_channel(turn_slip=0.08)
    _, changed = body_channel(turn_slip=late_k_s)
    second = line.pose.t_s > line.t_s[-1] / 2.0
    poses = np.where(second[:, None], changed.pose_values, line.pose_values)
    return type(channel).build(replace(line, pose_values=poses), channel.noise, channel.neutral)


def test_halves_that_disagree_widen_the_interval_to_hold_both():
    names = ("turn_slip",)
    same, drifting = changing(0.08), changing(0.16)
    found = [estimated(one, names).by_name["turn_slip.k_s"] for one in (same, drifting)]
    result = ChannelResult(Selector(drifting, body_moves(drifting)), names, drifting)
    early, late = in_logs(result, (0.0, 0.5 * drifting.drive.duration_s))["turn_slip.k_s"].values
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


def test_each_of_several_logs_speaks_for_itself():
    channel = changing(0.16)
    result = ChannelResult(Selector(channel, body_moves(channel)), ("turn_slip",), channel)
    found = in_logs(result, (0.0, 0.5 * channel.drive.duration_s))
    assert found["turn_slip.k_s"].values == pytest.approx((0.08, 0.16), abs=0.03)
    assert found["turn_slip.k_s"].apart(0, 1) > 3.0
    assert abs(found["wheel_radius_m"].apart(0, 1)) < 3.0
    assert in_logs(result, (0.0,)) == {}
    assert in_thirds(result)["turn_slip.k_s"].values.size == 3


def test_a_parameter_that_changes_along_a_log_is_said_to_drift_and_another_is_not():
    for channel, drifts in ((changing(0.08), False), (changing(0.16), True)):
        result = ChannelResult(Selector(channel, body_moves(channel)), ("turn_slip",), channel)
        analysis = GapAnalysis(channel.drive, channel.neutral, WHEEL.neutral, result, None)
        said = drifting_parameters(analysis, final_fit(analysis))
        assert bool(said) == drifts
        assert not drifts or said[0].startswith("turn_slip.k_s drifts: 0.0")


def test_logs_of_one_robot_differ_in_what_changed_between_them_alone():
    for late_k_s, differs in ((0.08, set()), (0.16, {"turn_slip.k_s"})):
        channel = changing(late_k_s)
        result = ChannelResult(Selector(channel, body_moves(channel)), ("turn_slip",), channel)
        analysis = GapAnalysis(channel.drive, channel.neutral, WHEEL.neutral, result, None)
        found = across_logs(analysis, (0.0, 0.5 * channel.drive.duration_s))
        assert {each.name for each in found} >= {"turn_slip.k_s", "wheel_radius_m", "x_icr_m"}
        assert {each.name for each in found if each.differs} - {"axial_distance_m"} == differs
        assert across_logs(analysis, (0.0,)) == ()
        for each in found:
            assert all(low < value < high for value, low, high in each.values)


@pytest.mark.parametrize(("of_halves", "of_quarters"), [(0.3, 0.1), (0.1, 0.3)])
def test_the_division_of_a_log_that_shows_most_says_how_far_a_parameter_wanders(monkeypatch, of_halves, of_quarters):
    spread = {2: of_halves, 4: of_quarters}

    def in_parts(found, parts):
        return {"motor_lag.tau_s": SimpleNamespace(variance_between=spread[np.unique(parts).size])}

    monkeypatch.setitem(wandered.__globals__, "in_parts", in_parts)
    channel = SimpleNamespace(block=np.repeat(np.arange(12), 5), settings=DEFAULT_SETTINGS)
    found = SimpleNamespace(channel=channel, selector=SimpleNamespace(channel=channel))
    assert wandered(found) == {"motor_lag.tau_s": 0.3}
