"""The interface of the fusion: estimates, ages, flags, counters, and that no stream of samples harms it."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest
from hypothesis import strategies as st

from disco_hw.config import Estimation
from disco_hw.estimation import PoseFusion
from disco_hw.estimation.correction import PoseReason
from disco_hw.estimation.odometry import OdometryParameters, advance
from drivers.types import PoseSample, WheelSample
from tests.tables import examples

MS = 1_000_000
PARAMETERS = OdometryParameters(0.061, 0.415, 0.238)
UNCERTAIN = OdometryParameters(0.061, 0.415, 0.238, ((1.5e-4, 0.0, 0.0), (0.0, 9e-5, 0.0), (0.0, 0.0, 1.3e-4)))


def fusion_with(parameters=PARAMETERS, **fields):
    return PoseFusion(Estimation(**fields), parameters, wheel_timeout_s=0.15)


def wheels(t_ms, left=0.0, right=0.0, speeds=(0.0, 0.0)):
    return WheelSample(t_ms * MS, t_ms * MS, left, right, *speeds)


def pose(t_ms, x=0.0, y=0.0, yaw=0.0, std=0.01):
    return PoseSample(t_ms * MS, t_ms * MS, x, y, yaw, std, std)


def running(**fields):
    """Standing at (1, 2) with yaw 0.5 since 0 ms, wheels at 10 ms."""
    fusion = fusion_with(**fields)
    fusion.add_wheels(wheels(0))
    assert fusion.add_pose(pose(0, 1.0, 2.0, 0.5), 0).reason is PoseReason.INITIALISED
    fusion.add_wheels(wheels(10))
    return fusion


def test_before_any_sample_the_estimate_says_that_it_knows_nothing():
    estimate = fusion_with().estimate(5 * MS)
    assert (estimate.initialised, estimate.wheels_ok, estimate.pose_ok, estimate.ok) == (False,) * 4
    assert (estimate.wheel_age_s, estimate.pose_age_s) == (None, None)
    np.testing.assert_array_equal(estimate.covariance, np.diag([1e4, 1e4, math.pi**2 / 3]))


def test_wheels_alone_do_not_initialise_where_a_pose_is_required():
    fusion = fusion_with()
    fusion.add_wheels(wheels(0, speeds=(3.0, 3.0)))
    estimate = fusion.estimate(5 * MS)
    assert (estimate.initialised, estimate.wheels_ok, estimate.pose_ok) == (False, True, False)
    without_pose = fusion_with(pose_required=False)
    without_pose.add_wheels(wheels(0))
    assert without_pose.estimate(5 * MS).initialised
    assert not without_pose.estimate(5 * MS).pose_ok


def test_a_pose_before_any_wheels_has_no_odometry():
    fusion = fusion_with()
    assert fusion.add_pose(pose(0), 0).reason is PoseReason.NO_ODOMETRY
    assert fusion.stats.poses_no_odometry == 1


def test_estimate_is_predicted_to_the_time_asked_for():
    fusion = running()
    fusion.add_wheels(wheels(20, 0.03, 0.04, (3.0, 4.0)))
    estimate = fusion.estimate(45 * MS)
    expected = advance(PARAMETERS, running().estimate(10 * MS).pose, [(3.0, 4.0, 0.01), (3.0, 4.0, 0.025)])
    assert msgspec.structs.astuple(estimate.pose) == pytest.approx(msgspec.structs.astuple(expected), abs=1e-12)
    assert estimate.t_ns == 45 * MS
    assert estimate.speed_m_s == pytest.approx(0.061 * 3.5)
    assert estimate.yaw_rate_rad_s == pytest.approx(0.061 / 0.415)
    assert (estimate.left_speed_rad_s, estimate.right_speed_rad_s) == (3.0, 4.0)
    assert (estimate.wheel_age_s, estimate.pose_age_s) == (pytest.approx(0.025), pytest.approx(0.045))
    assert estimate.ok


def test_asking_does_not_change_the_filter():
    queried, silent = running(), running()
    for t_ms in (20, 500, 30):
        queried.estimate(t_ms * MS)
    for fusion in (queried, silent):
        fusion.add_wheels(wheels(40, 0.1, 0.1))
    assert queried.estimate(50 * MS) == silent.estimate(50 * MS)


def test_a_time_before_the_newest_sample_gets_the_newest_pose():
    fusion = running()
    fusion.add_wheels(wheels(20, 0.5, 0.5, (50.0, 50.0)))
    assert fusion.estimate(19 * MS).pose == fusion.estimate(20 * MS).pose


def test_without_poses_it_predicts_only_and_says_so_after_the_timeout():
    fusion = running(pose_timeout_s=0.5)
    variances = []
    for t_ms in range(20, 1000, 10):
        fusion.add_wheels(wheels(t_ms, t_ms * 3e-3, t_ms * 3e-3, (3.0, 3.0)))
        estimate = fusion.estimate(t_ms * MS)
        assert estimate.pose_ok is (t_ms <= 500)
        variances.append(estimate.covariance[0][0])
    assert (np.diff(variances) > 0.0).all()
    assert estimate.x_m == pytest.approx(1.0 + 0.061 * 3.0 * 0.99 * math.cos(0.5))
    assert fusion.add_pose(pose(990, estimate.x_m, estimate.y_m, 0.5), 990 * MS).accepted
    assert fusion.estimate(1000 * MS).pose_ok


def test_rejected_poses_do_not_keep_the_pose_alive():
    fusion = running(pose_timeout_s=0.3)
    for t_ms in range(20, 401, 20):
        fusion.add_wheels(wheels(t_ms))
        assert fusion.add_pose(pose(t_ms, (-1) ** t_ms + t_ms, 50.0), t_ms * MS).reason is PoseReason.GATED
    estimate = fusion.estimate(400 * MS)
    assert not estimate.pose_ok
    assert estimate.pose_age_s == pytest.approx(0.4)


def test_silent_wheels_are_flagged_with_their_age():
    fusion = running()
    assert fusion.estimate(160 * MS).wheels_ok
    stale = fusion.estimate(161 * MS)
    assert not stale.wheels_ok
    assert not stale.ok
    assert stale.wheel_age_s == pytest.approx(0.151)


def test_pose_update_carries_innovation_variances_ratio_and_age():
    fusion = running()
    fusion.add_wheels(wheels(20))
    update = fusion.add_pose(pose(15, 1.01, 1.99, 0.51), 40 * MS)
    assert (update.reason, update.accepted) == (PoseReason.ACCEPTED, True)
    assert update.age_s == pytest.approx(0.025)
    assert update.innovation == pytest.approx((0.01, -0.01, 0.01), abs=1e-9)
    assert update.innovation_variance == pytest.approx((2e-4, 2e-4, 2e-4), rel=0.01)
    assert update.distance2 == pytest.approx(3 * 1e-4 / 2e-4, rel=0.01)
    assert update.test_ratio == pytest.approx(update.distance2 / 16.266, rel=1e-3)


def test_yaw_passes_through_pi_without_a_jump():
    fusion = fusion_with()
    fusion.add_wheels(wheels(0))
    fusion.add_pose(pose(0, 0.0, 0.0, 3.0), 0)
    speed = 1.0 * 0.415 / 0.061 / 2  # 1 rad/s on the spot
    for k in range(1, 41):
        t = k * 0.01
        fusion.add_wheels(wheels(10 * k, -speed * t, speed * t, (-speed, speed)))
        yaw = math.remainder(3.0 + t, math.tau)
        position = (0.238 * (math.cos(3.0) - math.cos(yaw)), 0.238 * (math.sin(3.0) - math.sin(yaw)))
        update = fusion.add_pose(pose(10 * k, *position, yaw), 10 * k * MS)
        assert update.accepted
        assert abs(update.innovation[2]) < 1e-6
    assert fusion.estimate(400 * MS).yaw_rad == pytest.approx(3.4 - math.tau, abs=1e-6)


@pytest.mark.parametrize("field", ["x_m", "y_m", "yaw_rad", "position_std_m", "yaw_std_rad"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_pose_that_is_not_finite_leaves_no_trace(field, value):
    fusion, untouched = running(), running()
    update = fusion.add_pose(msgspec.structs.replace(pose(10), **{field: value}), 10 * MS)
    assert (update.reason, update.innovation) == (PoseReason.NOT_FINITE, None)
    assert fusion.estimate(20 * MS) == untouched.estimate(20 * MS)
    assert fusion.stats.poses_not_finite == 1


def test_a_pose_from_the_future_is_refused_beyond_the_tolerance():
    fusion = running()
    assert fusion.add_pose(pose(60, 1.0, 2.0, 0.5), 10 * MS).reason is PoseReason.ACCEPTED
    assert fusion.add_pose(pose(61, 1.0, 2.0, 0.5), 10 * MS).reason is PoseReason.FUTURE


def test_each_sample_is_counted_once():
    fusion = fusion_with(gate_lockout_count=2)
    fusion.add_wheels(wheels(0))
    fusion.add_wheels(wheels(10))
    fusion.add_wheels(wheels(10))
    fusion.add_wheels(wheels(20, math.nan))
    fusion.add_wheels(wheels(20, 1e10))
    fusion.add_wheels(msgspec.structs.replace(wheels(9000), received_ns=20 * MS))
    fusion.add_wheels(wheels(500, 1000.0, 1000.0))
    for sample in (pose(10), pose(11, std=0.0), pose(12, 5.0), pose(13, 5.0), pose(13, 6.0), pose(14, 2000.0)):
        fusion.add_pose(sample, 500 * MS)
    for sample in (pose(15, math.nan), pose(900), pose(-1, std=0.0)):
        fusion.add_pose(sample, 500 * MS)
    counted = dataclasses.asdict(fusion.stats)
    others = {"wheels_accepted": 3, "poses_no_odometry": 0, "poses_overflow": 0, "pose_gaps": 0}
    assert counted == dict.fromkeys(counted, 1) | others
    assert len(counted) == 20


anything = st.floats(allow_nan=True, allow_infinity=True)
plausible = st.floats(-20, 20)
number = st.one_of(plausible, plausible, plausible, anything)
wheel_events = st.tuples(st.just("wheels"), st.integers(-200, 900), number, number, number, number)
pose_events = st.tuples(
    st.just("pose"), st.integers(-1500, 200), number, number, number, st.one_of(number, st.just(0.01))
)
queries = st.tuples(st.just("ask"), st.integers(-500, 5000))


@examples(
    quick=40,
    every=150,
    events=st.lists(st.one_of(wheel_events, wheel_events, pose_events, queries), max_size=60),
    known=st.booleans(),
    pose_required=st.booleans(),
)
def test_no_stream_of_samples_harms_the_estimate(events, known, pose_required):
    fusions = [
        fusion_with(PARAMETERS if known else UNCERTAIN, pose_required=pose_required, gate_lockout_count=2)
        for _ in range(2)
    ]
    now_ms, results = 0, []
    for kind, offset_ms, *values in [*events, ("ask", 0)]:
        if kind == "wheels":
            now_ms += max(0, offset_ms)
            sample = WheelSample((now_ms + min(0, offset_ms)) * MS, now_ms * MS, *values)
            results.append([fusion.add_wheels(sample) for fusion in fusions])
        elif kind == "pose":
            x, y, yaw, std = values
            sample = PoseSample((now_ms + offset_ms) * MS, now_ms * MS, x, y, yaw, std, std)
            results.append([fusion.add_pose(sample, now_ms * MS) for fusion in fusions])
        else:
            results.append([fusion.estimate((now_ms + offset_ms) * MS) for fusion in fusions])
            estimate = results[-1][0]
            covariance = np.array(estimate.covariance)
            assert covariance.shape == (3, 3)
            assert np.isfinite([*covariance.ravel(), estimate.x_m, estimate.y_m, estimate.speed_m_s]).all()
            np.testing.assert_array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance)[0] > 0.0
            assert covariance[0, 0] <= 1e4 * (1 + 1e-9)
            assert covariance[2, 2] <= math.pi**2 / 3 * (1 + 1e-9)
            assert -math.pi < estimate.yaw_rad <= math.pi
    # Bit for bit the same from the same calls, poses' verdicts and counters included.
    for first, second in results:
        assert repr(first) == repr(second)
    assert fusions[0].stats == fusions[1].stats


def test_a_time_without_poses_is_counted_once_and_a_steady_rate_never():
    fusion = fusion_with()
    for ms in (*range(0, 2000, 40), *range(2200, 4000, 40), *range(4000, 6000, 100)):
        fusion.add_pose(pose(ms), ms * MS)
    assert fusion.stats.pose_gaps == 1


def test_poses_of_240_hz_are_used_all_the_time_and_their_thinning_is_said_once():
    fusion, ages_s = fusion_with(), []
    for tick in range(150):
        now_ms = 20 * tick
        for t_ms in (now_ms - 10, now_ms):
            fusion.add_wheels(wheels(t_ms))
        for k in range(240 * (now_ms - 20) // 1000 + 1, 240 * now_ms // 1000 + 1):
            fusion.add_pose(msgspec.structs.replace(pose(0), t_ns=k * 1_000_000_000 // 240), now_ms * MS)
        ages_s.append(fusion.estimate(now_ms * MS).pose_age_s)
    assert max(ages_s[2:]) < 0.015
    assert fusion.stats.poses_accepted + fusion.stats.poses_overflow == pytest.approx(720, abs=5)
    assert fusion.sources.new_messages() == ["poses: more than 100 poses a second; the rest is left out"]
