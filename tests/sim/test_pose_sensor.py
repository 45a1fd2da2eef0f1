"""Rate, noise, latency, losses and faults of the pose sensor."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sim.body_dynamics import Pose
from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from sim.pose_sensor import PoseSensor, wrapped

NOISY = PlantParameters()
STILL = NOISY.noiseless()


def measure(parameters, count, pose=None, seed=1, **effects):
    """`count` samples of a robot at rest; None where one was lost."""
    sensor = PoseSensor(parameters, hidden_effects(effects), np.random.SeedSequence(seed))
    return [sensor.sample(pose or Pose()) for _ in range(count)]


def errors(measurements, pose=None):
    pose = pose or Pose()
    return np.array(
        [(m.x_m - pose.x_m, m.y_m - pose.y_m, wrapped(m.yaw_rad - pose.yaw_rad)) for m in measurements if m]
    )


def test_samples_come_at_the_rate_and_can_be_read_after_the_delay():
    measured = measure(STILL, 5)
    assert [m.sample_us for m in measured] == [40_000, 80_000, 120_000, 160_000, 200_000]
    assert [m.available_us - m.sample_us for m in measured] == [30_000] * 5
    assert errors(measured).max() == 0.0


def test_noise_is_white_with_the_stated_standard_deviations():
    error = errors(measure(NOISY, 4000))
    np.testing.assert_allclose(error.std(axis=0), [0.005, 0.005, 0.0087], rtol=0.05)
    assert np.abs(error.mean(axis=0)).max() < 4 * 0.0087 / math.sqrt(4000)
    for column in error.T:
        assert abs(np.corrcoef(column[:-1], column[1:])[0, 1]) < 0.06
    assert np.abs(np.corrcoef(error.T) - np.eye(3)).max() < 0.06
    sample = measure(NOISY, 1)[0]
    assert (sample.position_std_m, sample.yaw_std_rad) == (0.005, 0.0087)


def test_correlated_noise_keeps_its_size():
    error = errors(measure(replace(NOISY, pose_noise_correlation_s=0.2), 8000))
    np.testing.assert_allclose(error.std(axis=0), [0.005, 0.005, 0.0087], rtol=0.1)
    assert np.corrcoef(error[:-5, 0], error[5:, 0])[0, 1] == pytest.approx(math.exp(-1.0), abs=0.06)


def test_volatile_noise_keeps_its_size_and_has_heavy_tails():
    error = errors(measure(replace(NOISY, pose_noise_volatility=0.5), 8000))[:, 0]
    assert error.std() == pytest.approx(0.005, rel=0.1)
    assert np.mean(error**4) / np.mean(error**2) ** 2 > 4.5


def test_sample_times_jitter_and_stay_in_order():
    measured = measure(replace(STILL, pose_sample_jitter_s=0.004), 2000)
    stamps = np.array([m.sample_us for m in measured])
    off = stamps - 40_000 * np.arange(1, 2001)
    assert off.std() == pytest.approx(4000, rel=0.06)
    wild = measure(replace(STILL, pose_sample_jitter_s=0.5), 2000)
    assert np.all(np.diff([m.sample_us for m in wild]) > 0)


def test_the_delay_jitters_and_is_never_negative():
    measured = measure(replace(STILL, pose_delay_jitter_s=0.02), 2000)
    delays = np.array([m.available_us - m.sample_us for m in measured])
    assert delays.min() == 0
    assert np.median(delays) == pytest.approx(30_000, rel=0.06)


def test_latency_asks_for_the_pose_of_earlier_and_stamps_it_as_of_now():
    sensor = PoseSensor(STILL, hidden_effects({"pose_latency": 0.1}), np.random.SeedSequence(1))
    asked, stamped = [], []
    for _ in range(4):
        asked.append(sensor.next_true_us)
        stamped.append(sensor.sample(Pose()).sample_us)
    assert asked == [0, 0, 20_000, 60_000]
    assert stamped == [40_000, 80_000, 120_000, 160_000]


def test_offset_turns_with_the_body_and_bias_turns_the_yaw_only():
    pose = Pose(1.0, 2.0, math.pi / 2)
    (m,) = measure(STILL, 1, pose, pose_offset=(0.1, 0.03))
    assert (m.x_m, m.y_m, m.yaw_rad) == pytest.approx((0.97, 2.1, math.pi / 2))
    (m,) = measure(STILL, 1, pose, heading_bias=0.05)
    assert (m.x_m, m.y_m, m.yaw_rad) == pytest.approx((1.0, 2.0, math.pi / 2 + 0.05))


def test_yaw_is_wrapped_to_the_half_open_range():
    assert measure(STILL, 1, Pose(0, 0, 3.5))[0].yaw_rad == pytest.approx(3.5 - 2 * math.pi)
    assert wrapped(math.pi) == wrapped(-math.pi) == math.pi
    assert wrapped(7 * math.pi) == pytest.approx(math.pi)


def test_dropouts_lose_their_share():
    measured = measure(replace(NOISY, pose_dropout_probability=0.1), 5000)
    assert sum(m is None for m in measured) / 5000 == pytest.approx(0.1, abs=0.015)


def test_gaps_silence_the_sensor_for_their_length():
    measured = measure(replace(NOISY, pose_gap_interval_s=20.0, pose_gap_length_s=1.2), 10_000)
    lost = np.array([m is None for m in measured], dtype=int)
    starts, ends = np.flatnonzero(np.diff(lost) == 1), np.flatnonzero(np.diff(lost) == -1)
    lengths = ends[1 : len(starts)] - starts[: len(ends) - 1] if ends[0] < starts[0] else ends - starts[: len(ends)]
    assert len(starts) == pytest.approx(10_000 / 25 / 20, rel=0.5)
    assert lengths.min() == 30


def test_outliers_are_rare_and_large_and_leave_the_other_samples_as_they_were():
    clean, dirty = errors(measure(NOISY, 5000)), errors(measure(replace(NOISY, pose_outlier_probability=0.02), 5000))
    hit = np.any(clean != dirty, axis=1)
    assert hit.mean() == pytest.approx(0.02, abs=0.007)
    jump = np.hypot(*(dirty - clean)[hit, :2].T)
    assert jump.min() == pytest.approx(0.05, abs=0.01)
    assert jump.max() == pytest.approx(0.2, abs=0.01)


def test_the_seed_decides_everything():
    assert measure(NOISY, 20) == measure(NOISY, 20)
    assert measure(NOISY, 20) != measure(NOISY, 20, seed=2)
