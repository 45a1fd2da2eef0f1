"""Whitening makes independent residuals of unit variance of the noise it describes."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import WHEEL
from disco_hw.gap.noise.body_noise import BodyMotion, BodyNoise, body_gains, body_likelihood, whiten_body
from disco_hw.gap.noise.wheel_noise import WheelMotion, WheelNoise, wheel_gains, wheel_likelihood, whiten_wheels
from disco_hw.gap.search.least_squares import fit
from disco_hw.gap.search.richest_model import indices
from disco_hw.gap.settings import GRID_STEP_S
from tests.gap.synthetic import line_of, wheels_on


def simulated(noise, speed, rng):
    dt = 0.02
    count = speed.shape[0]
    residual = np.empty((count, 2))
    keep = np.exp(-dt / noise.correlation_s)
    for side in (0, 1):
        error, drift = noise.relative * rng.standard_normal(), 0.0
        for k in range(count):
            drift += speed[k, side] * dt * error
            error = keep * error + noise.relative * np.sqrt(1 - keep**2) * rng.standard_normal()
            residual[k, side] = drift + noise.reading_rad * rng.standard_normal()
    return residual


def driven(speed, restart):
    count = speed.shape[0]
    use = np.arange(count) % 17 != 5
    return WheelMotion(np.full(count, 0.02), speed, speed, np.zeros(count), restart, use)


def test_wheel_residuals_become_white():
    rng = np.random.default_rng(0)
    count = 4000
    noise = WheelNoise(0.02, 0.2, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6)
    speed = np.full((count, 2), 4.0)
    residual = simulated(noise, speed, rng)
    flags = np.arange(count) == 0
    gains = wheel_gains(
        noise, WheelMotion(np.full(count, 0.02), speed, speed, np.zeros(count), flags, np.ones(count, bool))
    )
    white = whiten_wheels(residual, gains)[1:, 0]
    assert white.var() == pytest.approx(1.0, abs=0.08)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.05


def test_whitening_is_linear():
    rng = np.random.default_rng(1)
    speed = rng.uniform(0, 5, (300, 2))
    gains = wheel_gains(WheelNoise(), driven(speed, np.arange(300) == 0))
    a, b = rng.standard_normal((2, 300, 2))
    np.testing.assert_allclose(
        whiten_wheels(a + 2 * b, gains), whiten_wheels(a, gains) + 2 * whiten_wheels(b, gains), atol=1e-9
    )


def test_the_likelihood_of_the_wheels_is_that_of_their_whitened_residuals():
    rng = np.random.default_rng(2)
    moved = driven(rng.uniform(-5, 5, (400, 2)), np.arange(400) % 200 == 0)
    noise, residual = WheelNoise(0.03, 0.3, 2e-3, 1e-3, 1e-3, 2e-3, 0.01), 0.01 * rng.standard_normal((400, 2))
    counted = moved.use & ~moved.restart
    white, weight = wheel_likelihood(moved, counted, residual)(noise.vector())
    gains = wheel_gains(noise, moved)
    np.testing.assert_allclose(white[counted], whiten_wheels(residual, gains)[counted], atol=1e-9)
    assert (white[~counted] == 0.0).all()
    assert weight == pytest.approx(np.log(gains.scale[counted]).sum())


def body_motion(count, rng):
    turned = np.cumsum(0.02 * rng.standard_normal(count))
    # Columns of a table, as those of a drive are.
    steps = 0.02 * rng.standard_normal((count, 2)).T
    restart, use = np.arange(count) % 100 == 0, np.arange(count) % 23 != 7
    rest = rng.uniform(0, 1, (3, count))
    return BodyMotion(np.full(count, 0.04), *steps, turned, *rest, restart, use)


def test_whitening_of_poses_is_linear_and_silent_where_none_is_used():
    rng = np.random.default_rng(3)
    moved = body_motion(120, rng)
    gains = body_gains(BodyNoise(0.01, 0.01, 1e-3, 0.02, 0.03, 0.05, 0.4, 0.02, 0.05), moved)
    a, b = 0.02 * rng.standard_normal((2, 120, 3))
    both = whiten_body(a + 2.0 * b, gains)
    np.testing.assert_allclose(both, whiten_body(a, gains) + 2.0 * whiten_body(b, gains), atol=1e-9)
    assert (both[~moved.use] == 0.0).all()


def test_the_likelihood_of_the_body_is_that_of_its_whitened_residuals():
    rng = np.random.default_rng(4)
    moved, noise = body_motion(300, rng), BodyNoise(0.01, 0.02, 2e-3, 0.02, 0.03, 0.05, 0.4, 0.02, 0.05)
    residual, counted = 0.02 * rng.standard_normal((300, 3)), moved.use & ~moved.restart
    white, weight = body_likelihood(moved, residual)(noise.vector())
    gains = body_gains(noise, moved)
    np.testing.assert_allclose(white[counted], whiten_body(residual, gains)[counted], atol=1e-9)
    assert (white[~counted] == 0.0).all()
    determinants = np.prod(np.diagonal(gains.scale[counted], axis1=1, axis2=2), axis=1)
    assert weight == pytest.approx(np.log(determinants).sum())


def test_a_body_at_rest_has_the_noise_of_its_poses_alone():
    count, rng = 4000, np.random.default_rng(5)
    still, restart = np.zeros(count), np.arange(count) == 0
    moved = BodyMotion(np.full(count, 0.04), still, still, still, still, still, still, restart, ~np.zeros(count, bool))
    noise = BodyNoise(0.01, 0.02, noise_correlation_s=1e-3)
    residual = rng.standard_normal((count, 3)) * (0.01, 0.01, 0.02) + (0.1, -0.1, 0.05)
    white = whiten_body(residual, body_gains(noise, moved))[10:]
    np.testing.assert_allclose(white.var(axis=0), 1.0, atol=0.1)
    assert abs(np.corrcoef(white[1:, 0], white[:-1, 0])[0, 1]) < 0.05


def test_a_slow_error_acts_on_the_speed_that_is_expected_and_tells_nothing_of_a_gain():
    # Starts and stops: a gain shows in each, and so does an error of the speed that is slower than all of them.
    asked = np.repeat(np.where(np.arange(60) % 2 == 0, 4.0, 0.0), 100)[:, None].repeat(2, axis=1)
    line = line_of(asked)
    stamped = WheelNoise(relative=1e-4, reading_rad=1e-3, stamp_s=4e-3, command_stamp_s=1e-5, drift_std=0.01)
    channel = wheels_on(line, stamped).expecting(WHEEL.neutral)
    gained = WHEEL.neutral.copy()
    gained[WHEEL.place["wheel_gain.left"]] = 0.01
    difference = channel.residual(gained) - channel.residual(WHEEL.neutral)
    # In 60 s there are two independent errors of 1 %, and what is told of their mean is not a mark more.
    assert float(difference @ difference) < 5.0
    np.testing.assert_allclose(channel.motion.expected_rad_s[10:45], 4.0)


def test_readings_with_an_error_make_no_gain():
    rng = np.random.default_rng(6)
    asked = np.repeat(rng.uniform(-5.0, 5.0, 60), 100)[:, None].repeat(2, axis=1)
    line = line_of(asked)
    read = line.encoder_angle_rad + 0.004 * rng.standard_normal((line.encoder.node.size, 2))
    between = np.column_stack([np.interp(line.t_s, line.t_s[line.encoder.node], side) for side in read.T])
    # As speeds are measured: over 20 ms either side.
    speed = (np.roll(between, -2, axis=0) - np.roll(between, 2, axis=0)) / (4.0 * GRID_STEP_S)
    line = replace(line, encoder_angle_rad=read, speed_rad_s=np.clip(speed, -6.0, 6.0))
    noise = WheelNoise(0.015, 0.16, 0.004, 1e-5, 1e-5, 1e-5, 1e-4)
    channel = wheels_on(line, noise)
    found = fit(channel, WHEEL.neutral, indices(channel, ("wheel_gain",)))
    gains = found.vector[list(found.active)]
    assert np.abs(gains).max() < 5e-4


def test_after_unknown_commands_the_wheels_angle_begins_anew():
    line = line_of(np.full((2000, 2), 3.0))
    line.command_rad_s[600:900] = np.nan
    channel = wheels_on(line)
    again = np.flatnonzero(np.diff(channel.motion.use.astype(int)) == 1) + 1
    assert again.size == 1
    assert channel.motion.restart[again].all()
    # Nine radians were turned meanwhile, of which the model knows nothing.
    assert np.abs(channel.whitened(WHEEL.neutral)).max() < 0.5
