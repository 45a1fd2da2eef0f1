"""Rate, noise, latency, losses and faults of the pose sensor."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sim.body_dynamics import BodyPose
from sim.effects import hidden_effects
from sim.plant_parameters import PlantParameters
from sim.sensors import Electrics, Encoders, SampledPoseSensor, wrapped
from sim.wheel_dynamics import WheelPieces

NOISY = PlantParameters()
NOISELESS = NOISY.noiseless()


def measure(parameters, count, pose=None, seed=1, **effects):
    """`count` samples of a robot at rest; None where one was lost."""
    sensor = SampledPoseSensor(parameters, hidden_effects(effects), np.random.SeedSequence(seed))
    return [sensor.sample(pose or BodyPose()) for _ in range(count)]


def errors(measurements, pose=None):
    pose = pose or BodyPose()
    return np.array(
        [(m.x_m - pose.x_m, m.y_m - pose.y_m, wrapped(m.yaw_rad - pose.yaw_rad)) for m in measurements if m]
    )


def test_samples_come_at_the_rate_and_can_be_read_after_the_delay():
    measured = measure(NOISELESS, 5)
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
    measured = measure(replace(NOISELESS, pose_sample_jitter_s=0.004), 2000)
    stamps = np.array([m.sample_us for m in measured])
    off = stamps - 40_000 * np.arange(1, 2001)
    assert off.std() == pytest.approx(4000, rel=0.06)
    wild = measure(replace(NOISELESS, pose_sample_jitter_s=0.5), 2000)
    assert np.all(np.diff([m.sample_us for m in wild]) > 0)


def test_the_delay_jitters_and_is_never_negative():
    measured = measure(replace(NOISELESS, pose_delay_jitter_s=0.02), 2000)
    delays = np.array([m.available_us - m.sample_us for m in measured])
    assert delays.min() == 0
    assert np.median(delays) == pytest.approx(30_000, rel=0.06)


def test_latency_asks_for_the_pose_of_earlier_and_stamps_it_as_of_now():
    sensor = SampledPoseSensor(NOISELESS, hidden_effects({"pose_latency": 0.1}), np.random.SeedSequence(1))
    true_times_us, stamped = [], []
    for _ in range(4):
        true_times_us.append(sensor.next_true_us)
        stamped.append(sensor.sample(BodyPose()).sample_us)
    assert true_times_us == [0, 0, 20_000, 60_000]
    assert stamped == [40_000, 80_000, 120_000, 160_000]


def test_offset_turns_with_the_body_and_bias_turns_the_yaw_only():
    pose = BodyPose(1.0, 2.0, math.pi / 2)
    (m,) = measure(NOISELESS, 1, pose, pose_offset=(0.1, 0.03))
    assert (m.x_m, m.y_m, m.yaw_rad) == pytest.approx((0.97, 2.1, math.pi / 2))
    (m,) = measure(NOISELESS, 1, pose, heading_bias=0.05)
    assert (m.x_m, m.y_m, m.yaw_rad) == pytest.approx((1.0, 2.0, math.pi / 2 + 0.05))


def test_yaw_is_wrapped_to_the_half_open_range():
    assert measure(NOISELESS, 1, BodyPose(0, 0, 3.5))[0].yaw_rad == pytest.approx(3.5 - 2 * math.pi)
    assert wrapped(math.pi) == wrapped(-math.pi) == math.pi
    assert wrapped(7 * math.pi) == pytest.approx(math.pi)


def test_dropouts_lose_their_share():
    measured = measure(replace(NOISY, pose_dropout_probability=0.1), 5000)
    assert sum(m is None for m in measured) / 5000 == pytest.approx(0.1, abs=0.015)


def test_gaps_silence_the_sensor_for_their_length():
    measured = measure(replace(NOISY, pose_gap_interval_s=20.0, pose_gap_length_s=1.2), 10_000)
    missing = np.array([m is None for m in measured], dtype=int)
    starts, ends = np.flatnonzero(np.diff(missing) == 1), np.flatnonzero(np.diff(missing) == -1)
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


TICK_RAD = 2.0 * math.pi / 2048


def _turn(encoders, angle_of_time, milliseconds, from_ms=0):
    """Turn both wheels to angle_of_time(t); return ticks and observed speeds at each millisecond."""
    ticks, speeds = [], []
    for k in range(from_ms, from_ms + milliseconds):
        pieces = WheelPieces(np.array([(k + 1) * 1000]), np.array([angle_of_time((k + 1) * 1e-3)]))
        encoders.advance(k * 1000, pieces, 1)
        ticks.append(encoders.ticks)
        speeds.append(encoders.speeds_rad_s)
    return np.array(ticks), np.array(speeds)


def test_ticks_are_whole_and_never_more_than_one_behind_the_angle():
    angles = lambda t: (3.0 * t, -2.0 * t)  # noqa: E731
    ticks, _ = _turn(Encoders(PlantParameters(), hidden_effects({})), angles, 2000)
    t = np.arange(1, 2001) * 1e-3
    behind = np.stack([3.0 * t, -2.0 * t], axis=1) / TICK_RAD - ticks
    assert ticks.dtype.kind == "i"
    assert behind.min() >= 0.0
    assert behind.max() < 1.0


def test_the_count_starts_where_it_is_set():
    parameters = PlantParameters(encoder_start_left_ticks=2**24 - 3, encoder_start_right_ticks=-7)
    encoders = Encoders(parameters, hidden_effects({}))
    assert encoders.ticks == (2**24 - 3, -7)
    ticks, speeds = _turn(encoders, lambda t: (10.5 * TICK_RAD, -9.5 * TICK_RAD), 1)
    assert ticks[-1].tolist() == [2**24 + 7, -17]
    stationary = Encoders(parameters, hidden_effects({}))
    _, speeds = _turn(stationary, lambda t: (0.0, 0.0), 200)
    assert np.all(speeds == 0.0)


def test_encoder_scale_counts_more_or_less_than_the_angle():
    encoders = Encoders(PlantParameters(), hidden_effects({"encoder_scale": (-0.02, 0.03)}))
    ticks, _ = _turn(encoders, lambda t: (100.0, 100.0), 1)
    assert ticks[0].tolist() == [math.floor(98.0 / TICK_RAD), math.floor(103.0 / TICK_RAD)]


def test_observed_speed_settles_at_the_speed_with_a_ripple_below_that_of_bare_differences():
    _, speeds = _turn(Encoders(PlantParameters(), hidden_effects({})), lambda t: (3.0 * t, -0.5 * t), 2000)
    settled = speeds[500:]
    assert settled.mean(axis=0) == pytest.approx((3.0, -0.5), abs=0.01)
    one_tick_per_step = TICK_RAD / 1e-3
    assert settled.std(axis=0).max() < 0.05 * one_tick_per_step


def test_observed_speed_lags_a_ramp_by_two_over_the_bandwidth_at_most():
    fine = PlantParameters(ticks_per_rev=2_000_000)
    _, speeds = _turn(Encoders(fine, hidden_effects({})), lambda t: (5.0 * t * t, 0.0), 1000)
    assert 10.0 - speeds[-1, 0] == pytest.approx(10.0 * 2.0 / 100.0, rel=0.05)


def test_observed_speed_is_zero_at_rest_whatever_the_place_within_a_tick():
    for part in np.linspace(0.01, 0.99, 9):
        encoders = Encoders(PlantParameters(), hidden_effects({}))
        _turn(encoders, lambda t: (3.0 * t, 3.0 * t), 300)
        rest = (math.floor(0.9 / TICK_RAD) + part) * TICK_RAD
        _, speeds = _turn(encoders, lambda t, rest=rest: (rest, rest), 500, from_ms=300)
        assert np.all(speeds[-100:] == 0.0)


PARAMETERS = PlantParameters()


def run(torques, speeds, seconds=1.0, **effects):
    electrics = Electrics(PARAMETERS, hidden_effects(effects))
    for k in range(round(seconds * 10)):
        electrics.advance((k + 1) * 0.1, 0.1, torques, speeds)
    return electrics


def test_current_is_torque_over_the_motor_constant_with_its_sign():
    assert run((0.5, -0.25), (1.0, 1.0)).motor_currents_a == pytest.approx((2.0, -1.0))


def test_the_battery_gives_mechanical_power_losses_and_idle_current():
    power_w = 0.5 * 4.0 + 0.25 * 2.0 + 0.3 * (2.0**2 + 1.0**2)
    battery = run((0.5, 0.25), (4.0, 2.0), 0.1).battery
    assert battery.current_a == pytest.approx(0.5 + power_w / 25.2)
    assert battery.voltage_v == pytest.approx(25.2 - 0.08 * battery.current_a, abs=1e-4)


def test_voltage_falls_with_load_and_with_charge():
    resting, working = run((0.0, 0.0), (0.0, 0.0)), run((3.0, 3.0), (5.0, 5.0))
    assert working.battery.voltage_v < resting.battery.voltage_v - 0.1
    assert run((3.0, 3.0), (5.0, 5.0), 600.0).battery.voltage_v < working.battery.voltage_v - 0.1


def test_battery_sag_shows_in_the_voltage():
    fresh, sagging = run((0.0, 0.0), (0.0, 0.0), 10.0), run((0.0, 0.0), (0.0, 0.0), 10.0, battery_sag=(0.1, 10.0))
    assert fresh.battery.voltage_v - sagging.battery.voltage_v == pytest.approx(2.52)


def test_motors_warm_up_towards_heat_times_thermal_resistance():
    current_a = 1.0 / 0.25
    final_c = 22.0 + 3.0 * 0.3 * current_a**2
    left, right = run((1.0, 0.0), (0.0, 0.0), 180.0).motor_temperatures_c
    assert left == pytest.approx(22.0 + (final_c - 22.0) * (1 - 2.718281828**-1), rel=0.01)
    assert right == 22.0
