"""The pieces of held-out predictions, each against what is computed by hand."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import WHEEL
from disco_hw.gap.data.gridded_drive import GridSamples
from disco_hw.gap.data.stamp_clock import picked
from disco_hw.gap.noise import SensorNoise
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.cross_validation import (
    Chain,
    Starts,
    chain_track,
    chain_wheels,
    errors_of,
    find_starts,
    floor_errors,
    fold_vectors,
    prediction_error,
    regimes_driven,
    smoothed_poses,
    summarise,
)
from disco_hw.gap.search.least_squares import Fit
from disco_hw.gap.settings import DEFAULT_SETTINGS, GRID_STEP_S, PredictionSettings
from tests.gap.synthetic import GEOMETRY, NOISE, line_of, vector_of, wheels_on

RADIUS_M, AXLE_M, X_ICR_M = GEOMETRY


def steady(left_rad_s, right_rad_s, seconds=8.0, pose=(0.0, 0.0, 0.0)):
    """A drive at steady wheel speeds and its body channel, with exact poses of a path that begins at this one."""
    line = line_of(np.repeat([[left_rad_s, right_rad_s]], round(seconds / GRID_STEP_S), axis=0))
    plain = BodyChannel.build(line, NOISE, vector_of())
    return with_poses(line, placed(plain.track(vector_of())[line.pose.node], pose))


def placed(track, pose):
    """A path (K, 3) from 0 as it is from another pose."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    x = pose[0] + cosine * track[:, 0] - sine * track[:, 1]
    return np.column_stack([x, pose[1] + sine * track[:, 0] + cosine * track[:, 1], pose[2] + track[:, 2]])


def with_poses(line, poses, samples=None, use=None):
    line = replace(line, pose_values=poses, pose=line.pose if samples is None else samples)
    return BodyChannel.build(line, NOISE, vector_of(), use)


def test_exact_poses_are_carried_exactly_along_the_path():
    channel = steady(2.0, 4.0, pose=(3.0, -2.0, 2.5))
    truth = placed(channel.track(vector_of()), (3.0, -2.0, 2.5))
    for poses in smoothed_poses(channel, vector_of()):
        known = np.isfinite(poses[:, 0])
        assert known.mean() > 0.95
        np.testing.assert_allclose(poses[known], truth[known], atol=1e-9)


def test_poses_at_rest_are_averaged_within_their_reach_and_their_run_and_taken_alone_from_the_nearest():
    line = line_of(np.zeros((800, 2)))
    line = replace(line, first=np.isin(np.arange(800), (0, 402)))
    rng = np.random.default_rng(1)
    values = rng.normal(0.0, 0.01, (line.pose.t_s.size, 3)) + np.where(line.pose.node < 402, 1.0, 2.0)[:, None]
    values[7] = 50.0
    use = np.arange(values.shape[0]) != 7
    channel = with_poses(line, values, use=use)
    smooth, alone = smoothed_poses(channel, vector_of())
    t_s = line.pose.t_s
    for node in (4, 5, 8, 36, 40, 60, 200, 333, 395, 396, 404, 417, 500, 760, 784, 793, 796, 798):
        now = node * GRID_STEP_S
        same = use & ((t_s < 4.02) == (now < 4.02))
        near = same & (np.abs(t_s - now) < 0.3 + 1e-9)
        if node in line.pose.node:
            np.testing.assert_allclose(smooth[node], values[near].mean(axis=0), atol=1e-9)
        nearest = np.argmin(np.where(use, np.abs(t_s - now), np.inf))
        np.testing.assert_allclose(alone[node], values[nearest], atol=1e-9)


def test_poses_at_the_end_of_their_reach_count_and_thin_ones_of_either_side():
    line = line_of(np.zeros((800, 2)))
    line = replace(line, settings=replace(line.settings, prediction=PredictionSettings(pose_reach_s=0.25)))
    poses = np.array([0, 25, 50, 80, 200, 260])
    samples = GridSamples(poses, np.zeros(6), line.t_s[poses], np.zeros(6, dtype=int))
    smooth, alone = smoothed_poses(
        with_poses(line, np.repeat([1.0, 3.0, 7.0, 9.0, 5.0, 4.0], 3).reshape(6, 3), samples), vector_of()
    )
    assert smooth[[0, 25, 195, 205, 255]][:, 0] == pytest.approx([2.0, 11.0 / 3.0, 5.0, 5.0, 4.0])
    assert alone[[0, 10, 25, 195, 205, 255]][:, 0] == pytest.approx([1.0, 1.0, 3.0, 5.0, 5.0, 4.0])


def test_where_no_pose_is_near_there_is_none():
    line = line_of(np.zeros((800, 2)))
    away = (line.pose.t_s > 2.0) & (line.pose.t_s < 3.5)
    channel = with_poses(line, np.ones((np.count_nonzero(~away), 3)), picked(line.pose, ~away))
    times = channel.samples.t_s
    apart_s = np.abs(line.t_s[:, None] - times).min(axis=1)
    for poses in smoothed_poses(channel, vector_of()):
        assert np.isnan(poses[apart_s > 0.1 + 1e-9]).all()
        np.testing.assert_allclose(poses[apart_s < 0.1 - 1e-9], 1.0)
    assert (apart_s > 0.11).sum() > 100


def thinner(channel, every):
    """The same drive with one pose in so many."""
    line, chosen = channel.drive, np.arange(0, channel.drive.pose.t_s.size, every)
    return with_poses(line, line.pose_values[chosen], picked(line.pose, chosen))


def starts_at(node, pose, end, block=None):
    count = len(node)
    block = np.zeros(count, dtype=np.int64) if block is None else np.array(block)
    return Starts(np.array(node), np.array(pose, dtype=float), np.array(end, dtype=float), block, ("curves",) * count)


def test_an_error_is_what_was_measured_less_what_was_predicted_seen_from_the_start():
    channel = steady(3.0, 3.0)
    # It looks along y and drives 0.18 m in 1 s; measured are 0.2 m ahead and 0.1 m to the left, a turn and a bit more.
    starts = starts_at([200], [[1.0, 2.0, 0.5 * np.pi]], [[0.9, 2.2, 2.5 * np.pi + 0.1]])
    error = prediction_error(channel, starts, vector_of(), channel.track(vector_of()), 1.0)
    assert error == pytest.approx(np.array([[0.02, 0.1, 0.1]]))
    turned = starts_at([200], [[1.0, 2.0, 0.5 * np.pi]], [[0.9, 2.2, 0.5 * np.pi - 0.1]])
    assert prediction_error(channel, turned, vector_of(), channel.track(vector_of()), 1.0)[0, 2] == pytest.approx(-0.1)


def test_ground_that_slopes_is_predicted_where_the_robot_looks():
    channel, downhill = steady(3.0, 3.0), vector_of(slope__drift_y_m_s=0.01)
    starts = starts_at([200], [[1.0, 2.0, 0.5 * np.pi]], [[1.0, 2.2, 0.5 * np.pi]])
    error = prediction_error(channel, starts, downhill, channel.track(downhill), 1.0)
    assert error == pytest.approx(np.array([[0.01, 0.0, 0.0]]), abs=1e-9)


def test_wheels_of_the_chain_are_as_they_turn_and_not_as_they_are_counted():
    channel = steady(-3.0, 3.0)
    t_s = channel.drive.t_s
    assert chain_wheels(channel, None, Chain(vector_of(), None))[0] is channel.drive.angle_rad
    assert chain_wheels(channel, wheels_on(channel.drive), Chain(vector_of(), None))[1] is channel.drive.speed_rad_s
    # They turn on the spot at 0.9 rad/s, of which a limit leaves a half; wheels of half the radius stay below it.
    q = vector_of(WHEEL, encoder_scale__left=0.1, encoder_scale__right=-0.2, yaw_rate_limit__limit_rad_s=0.45)
    angle, speed = chain_wheels(channel, wheels_on(channel.drive), Chain(vector_of(), q))
    np.testing.assert_allclose(angle, np.outer(t_s, (-1.5, 1.5)), atol=1e-9)
    np.testing.assert_allclose(speed[1:], np.broadcast_to((-1.5, 1.5), (t_s.size - 1, 2)), atol=1e-9)
    assert (speed[0] == 0.0).all()
    small = chain_wheels(channel, wheels_on(channel.drive), Chain(vector_of(wheel_radius_m=0.5 * RADIUS_M), q))[0]
    np.testing.assert_allclose(small, np.outer(t_s, (-3.0, 3.0)), atol=1e-9)


def test_terms_of_the_wheels_and_of_the_body_drive_the_chain():
    channel = steady(3.0, 3.0)
    t_s, count = channel.drive.t_s, channel.drive.t_s.size
    extra = np.column_stack([np.full(count, 0.02), np.zeros(count), np.zeros(count)])
    chain = Chain(vector_of(), WHEEL.neutral, extra, np.full((count, 2), 1.0))
    track, speed = chain_track(channel, wheels_on(channel.drive), chain)
    np.testing.assert_allclose(track[:, 0], (0.24 + 0.02) * t_s, atol=1e-9)
    np.testing.assert_allclose(speed[1:], 4.0, atol=1e-9)
    known = replace(channel, drive=replace(channel.drive, known_motion=2.0 * extra))
    np.testing.assert_allclose(chain_track(known, None, chain)[0][:, 0], (0.18 + 0.06) * t_s, atol=1e-9)


def test_encoders_that_count_wrong_matter_to_the_body_only_where_they_are_read():
    channel = steady(3.0, 3.0)
    body = vector_of(encoder_scale__left=0.25, encoder_scale__right=0.25)
    for wheels, commanded in ((None, None), (None, WHEEL.neutral), (wheels_on(channel.drive), None)):
        read = chain_track(channel, wheels, Chain(body, commanded))[0]
        np.testing.assert_allclose(read[:, 0], 0.18 / 1.25 * channel.drive.t_s, atol=1e-9)
    commanded = chain_track(channel, wheels_on(channel.drive), Chain(body, WHEEL.neutral))[0]
    np.testing.assert_allclose(commanded[:, 0], 0.18 * channel.drive.t_s, atol=1e-9)
    turned = np.outer(channel.drive.t_s, (1.0, 1.0)), np.ones((channel.drive.t_s.size, 2))
    given = chain_track(channel, None, Chain(vector_of(), None), turned)
    np.testing.assert_allclose(given[0][:, 0], 0.06 * channel.drive.t_s, atol=1e-9)
    assert given[1] is turned[1]


def test_predictions_start_where_poses_are_known_at_both_ends_and_commands_all_the_way():
    channel = steady(3.0, 3.0, seconds=60.0)
    smooth, alone = smoothed_poses(channel, vector_of())
    smooth, alone = smooth.copy(), alone.copy()
    smooth[1000:1100], alone[2000:2100] = np.nan, np.nan
    drive = replace(channel.drive, command_rad_s=channel.drive.command_rad_s.copy())
    drive.command_rad_s[3000:3050] = np.nan
    starts = find_starts(replace(channel, drive=drive), (smooth, alone), 2.0)
    nodes = np.arange(100, 6000 - 201, 20)
    kept = [k for k in nodes if not (1000 <= k < 1100 or 1800 <= k < 1900 or 2800 <= k < 3050)]
    assert set(kept) - set(starts.node) <= {2799, *nodes[-3:]}
    assert set(starts.node) <= set(kept)
    np.testing.assert_array_equal(starts.pose, smooth[starts.node])
    np.testing.assert_array_equal(starts.end, alone[starts.node + 200])
    np.testing.assert_array_equal(starts.block, starts.node // 900)
    assert set(starts.regime) == {"straight ahead"}
    # Without any commands the wheels' own turns are enough.
    silent = replace(drive, command_rad_s=np.full_like(drive.command_rad_s, np.nan))
    uncommanded = find_starts(replace(channel, drive=silent), (smooth, alone), 2.0).node
    assert set(starts.node) < set(uncommanded)


def test_each_start_is_predicted_by_the_chain_of_its_own_stretch():
    channel = steady(3.0, 5.0, seconds=45.0)
    poses = smoothed_poses(channel, vector_of())
    wheels = wheels_on(replace(channel.drive, command_rad_s=channel.drive.command_rad_s + 1.0))
    # In one kind of stretches the wheels turn too fast.
    right, wrong = Chain(vector_of(), None), Chain(vector_of(), WHEEL.neutral)
    both = errors_of(channel, None, {0: right, 1: right}, 2.0, poses)
    assert both.position_m < 1e-9
    assert both.wheel_rad_s == 0.0
    first = errors_of(channel, wheels, {0: wrong, 1: right}, 2.0, poses)
    second = errors_of(channel, wheels, {0: right, 1: wrong}, 2.0, poses)
    np.testing.assert_array_equal(first.squares[:, 0] > 1e-6, (True, False, True, False, True))
    np.testing.assert_array_equal(second.squares[:, 0] > 1e-6, (False, True, False, True, False))


def test_speeds_of_wheels_are_compared_where_a_prediction_ends():
    channel = steady(3.0, 5.0, seconds=45.0)
    poses = smoothed_poses(channel, vector_of())
    # For 20 s they are commanded faster by 1 rad/s than they are measured to turn.
    faster = channel.drive.t_s < 20.0
    wheels = wheels_on(replace(channel.drive, command_rad_s=channel.drive.command_rad_s + faster[:, None]))
    told = errors_of(channel, wheels, {fold: Chain(vector_of(), WHEEL.neutral) for fold in (0, 1)}, 2.0, poses)
    ends = find_starts(channel, poses, 2.0).node + 200
    assert told.wheel_rad_s == pytest.approx(np.sqrt(faster[ends].mean()), rel=0.01)


def test_errors_are_root_mean_squares_by_regime_and_by_stretch():
    error = np.array([[3.0, 4.0, 0.1], [0.0, 1.0, -0.2], [2.0, 0.0, 0.2], [0.0, 0.0, 0.0]])
    starts = replace(starts_at([0, 1, 2, 3], error, error, [0, 0, 2, 2]), regime=("curves", "rest", "curves", "rest"))
    told = summarise(error, np.array([1.0, -3.0, 1.0, 1.0]), starts, DEFAULT_SETTINGS.prediction)
    assert told.position_m == pytest.approx(np.sqrt((25.0 + 1.0 + 4.0) / 4.0))
    assert told.yaw_rad == pytest.approx(0.15)
    assert told.wheel_rad_s == pytest.approx(np.sqrt(3.0))
    assert told.by_regime_m == {"curves": pytest.approx(np.sqrt(14.5)), "rest": pytest.approx(np.sqrt(0.5))}
    np.testing.assert_allclose(told.squares, [[26.0, 0.05], [4.0, 0.04]])
    # Of two stretches either may be drawn twice.
    assert told.position_ci == pytest.approx((np.sqrt(2.0), np.sqrt(13.0)))
    assert told.yaw_ci == pytest.approx((np.sqrt(0.02), np.sqrt(0.025)))
    # Of no predictions nothing is told.
    nothing = np.empty((0, 3))
    told = summarise(nothing, np.empty(0), starts_at([], nothing, nothing), DEFAULT_SETTINGS.prediction)
    assert np.isnan([told.position_m, *told.position_ci, told.yaw_rad, *told.yaw_ci, told.wheel_rad_s]).all()
    assert told.by_regime_m == {}
    assert told.squares is None


def test_an_interval_holds_what_stretches_scatter():
    rng = np.random.default_rng(2)
    of_stretch = rng.uniform(0.5, 1.5, 300)
    counts = rng.integers(1, 6, 300)
    block = np.repeat(np.arange(300), counts)
    squares = of_stretch[block]
    error = np.column_stack([np.sqrt(squares), np.zeros(block.size), np.sqrt(squares)])
    starts = starts_at(np.arange(block.size), error, error, block)
    told = summarise(error, np.zeros(block.size), starts, PredictionSettings(resamples=10_000))
    # A ratio of two sums over stretches: its deviation to first order.
    mean = squares.mean()
    deviation = np.sqrt((counts**2 * (of_stretch - mean) ** 2).sum()) / counts.sum()
    assert (np.square(told.position_ci) - mean) / deviation == pytest.approx((-1.96, 1.96), abs=0.06)
    assert told.yaw_ci == told.position_ci


@pytest.mark.parametrize("odd_one", [0, 4])
def test_each_stretch_is_drawn_as_often_as_any_other(odd_one):
    error = np.zeros((5, 3))
    error[odd_one] = 1.0
    starts = starts_at(np.arange(5), error, error, np.arange(5))
    told = summarise(error, np.zeros(5), starts, PredictionSettings(resamples=10_000))
    # Of five draws the odd one is three or more in 5.8 % and four or more in 0.7 %.
    assert told.yaw_ci == pytest.approx((0.0, np.sqrt(3.0 / 5.0)))


@pytest.mark.parametrize("every", [1, 4, 25])
def test_the_floor_is_the_noise_of_a_pose_and_of_a_mean_and_a_heading_that_is_off_at_the_start(every):
    channel = thinner(steady(3.0, 5.0, seconds=40.0, pose=(0.0, 0.0, 0.7)), every)
    floor = floor_errors(channel, SensorNoise(0.004, 0.01, 0.05), 2.0, smoothed_poses(channel, vector_of()))
    # Poses within 0.3 s either side are averaged, one every 0.04 s.
    many = max(0.6 / (0.04 * every), 1.0)
    v, omega = 0.24, RADIUS_M / AXLE_M * 2.0
    turned = omega * 2.0
    way_m = np.hypot(v / omega, X_ICR_M) * 2.0 * np.sin(0.5 * turned)
    assert floor.yaw_rad == pytest.approx(0.01 * np.sqrt(1.0 + 1.0 / many), rel=0.04)
    position = 2.0 * 0.004**2 * (1.0 + 1.0 / many) + (way_m * 0.01) ** 2 / many
    assert floor.position_m == pytest.approx(np.sqrt(position), rel=0.04)
    assert floor.wheel_rad_s == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("wheels", "heading_rad", "way_m"),
    [
        ((3.0, 3.0), 0.2, 0.36),
        ((3.0, 3.0), 1.9, 0.36),
        # On a circle about a point beside the axle, 1.8 rad of it.
        ((1.0, 7.0), 0.0, np.hypot(0.24 / 0.9, X_ICR_M) * 2.0 * np.sin(0.9)),
    ],
)
def test_a_heading_that_is_off_at_the_start_moves_the_end_aside_by_the_way(wheels, heading_rad, way_m):
    channel = thinner(steady(*wheels, seconds=40.0, pose=(0.0, 0.0, heading_rad)), 4)
    floor = floor_errors(channel, SensorNoise(1e-9, 0.01, 0.0), 2.0, smoothed_poses(channel, vector_of()))
    # One pose every 0.16 s, of those within 0.3 s either side.
    assert floor.position_m == pytest.approx(way_m * 0.01 / np.sqrt(0.6 / 0.16), rel=0.04)


def test_a_fold_is_predicted_by_a_fit_of_the_others():
    rng = np.random.default_rng(6)
    fold = np.arange(1000) // 70 % 3
    slope = rng.standard_normal((1000, 3))
    y = slope @ (0.5, -2.0, 1.0) + rng.standard_normal(1000)
    whole = np.linalg.lstsq(slope, y, rcond=None)[0]
    vector = np.array([9.0, *whole])
    residual = slope @ whole - y
    found = Fit(vector, (1, 2, 3), 0.5 * float(residual @ residual), residual, slope)
    folds = fold_vectors(found, fold, 3, np.zeros(4), DEFAULT_SETTINGS)
    for held in range(3):
        others = fold != held
        expected = np.linalg.lstsq(slope[others], y[others], rcond=None)[0]
        assert folds[held] == pytest.approx([9.0, *expected], rel=1e-9)
    # A fold of which nothing was measured is predicted by all there is.
    fewer = fold_vectors(found, np.where(fold == 1, 3, fold), 4, np.zeros(4), DEFAULT_SETTINGS)
    assert fewer[1] is vector
    assert fewer[3] == pytest.approx(folds[1], rel=1e-9)
    none = fold_vectors(Fit(vector, (), 0.0, residual, np.empty((1000, 0))), fold, 3, np.zeros(4), DEFAULT_SETTINGS)
    assert none[0] is none[1] is none[2] is vector
    single = fold_vectors(found, np.zeros(1000, dtype=int), 2, np.zeros(4), DEFAULT_SETTINGS)
    assert single[0] is single[1] is vector


def test_what_is_expected_of_a_parameter_is_expected_of_each_fold():
    rng = np.random.default_rng(7)
    fold, precision, neutral = np.arange(1000) // 70 % 2, np.array([0.0, 400.0]), np.array([0.0, 0.2])
    slope = rng.standard_normal((1000, 2))
    y = slope @ (0.5, 1.0) + rng.standard_normal(1000)

    def fitted(rows):
        # An expected value is one more row, of its weight.
        wide = np.vstack([slope[rows], np.diag(precision**0.5)])
        return np.linalg.lstsq(wide, np.append(y[rows], precision**0.5 * neutral), rcond=None)[0]

    whole = fitted(np.ones(1000, dtype=bool))
    residual = slope @ whole - y
    found = Fit(whole, (0, 1), 0.0, residual, slope, precision)
    folds = fold_vectors(found, fold, 2, neutral, DEFAULT_SETTINGS)
    for held in (0, 1):
        assert folds[held] == pytest.approx(fitted(fold != held), rel=1e-9)
    assert abs(folds[0][1] - folds[1][1]) < 0.1


@pytest.mark.parametrize(("value", "used"), [(1.2, True), (-1.2, True), (1.0, False), (0.8, False)])
def test_what_the_other_fold_says_little_of_is_used_if_it_fixes_the_value_itself(value, used):
    fold = np.arange(1400) // 70 % 2
    slope = np.zeros((1400, 1))
    # Nearly all is known from the even stretches: of the odd ones 25 in squares, five sigmas of a value of one.
    odd = fold == 1
    slope[np.flatnonzero(odd)[:25], 0], slope[~odd, 0] = 1.0, 20.0
    residual = np.zeros(1400)
    found = Fit(np.array([value]), (0,), 0.0, residual, slope)
    folds = fold_vectors(found, fold, 2, np.array([0.25]), DEFAULT_SETTINGS)
    assert folds[0][0] == (value if used else 0.25)
    assert folds[1][0] == value


def moving(v_m_s, omega_rad_s):
    """A drive at a steady speed and yaw rate."""
    both, apart = v_m_s / (0.5 * RADIUS_M), omega_rad_s * AXLE_M / RADIUS_M
    return steady(0.5 * (both - apart), 0.5 * (both + apart))


@pytest.mark.parametrize(
    ("v_m_s", "omega_rad_s", "told"),
    [
        (0.019, 0.099, "standstill"),
        (-0.019, -0.099, "standstill"),
        (0.021, 0.0, "straight ahead"),
        (0.0, 0.101, "turning on the spot"),
        (0.059, -0.101, "turning on the spot"),
        (0.061, 0.101, "straight ahead"),
        (0.059, 0.099, "straight ahead"),
        (0.2, 0.31, "curves"),
        (-0.2, -0.31, "curves"),
        (0.2, 0.29, "straight ahead"),
        (-0.2, 0.29, "straight back"),
    ],
)
def test_a_regime_is_told_by_mean_speed_and_mean_yaw_rate(v_m_s, omega_rad_s, told):
    channel = moving(v_m_s, omega_rad_s)
    assert regimes_driven(channel, np.array([0, 100, 300]), 200) == [told] * 3
    assert regimes_driven(channel, np.array([0, 100]), 20) == [told] * 2
    assert regimes_driven(channel, np.array([], dtype=int), 20) == []


@pytest.mark.parametrize(
    ("bound", "v_m_s", "omega_rad_s"),
    [
        ("standing_m_s", 0.0, 0.0),
        ("standing_m_s", 0.0, 0.2),
        ("spinning_rad_s", 0.03, 0.0),
        ("speeding_m_s2", 0.3, 0.0),
        ("turning_rad_s", 0.3, 0.0),
    ],
)
def test_at_a_bound_of_a_regime_the_robot_is_not_in_it(bound, v_m_s, omega_rad_s):
    channel = moving(v_m_s, omega_rad_s)
    settings = replace(DEFAULT_SETTINGS, prediction=replace(DEFAULT_SETTINGS.prediction, **{bound: 0.0}))
    channel = replace(channel, drive=replace(channel.drive, settings=settings))
    assert regimes_driven(channel, np.array([100]), 200) == ["straight ahead"]


@pytest.mark.parametrize(("faster_m_s", "told"), [(0.245, "straight ahead"), (0.255, "speeding up and braking")])
def test_a_robot_speeds_up_by_what_its_speed_spans_on_the_way(faster_m_s, told):
    line = line_of(np.repeat(np.linspace(5.0, 5.0 + 2.0 * faster_m_s / RADIUS_M, 401)[:, None], 2, axis=1))
    channel = BodyChannel.build(line, NOISE, vector_of())
    # Half of all of it in half the time.
    assert regimes_driven(channel, np.array([100]), 201) == [told]
