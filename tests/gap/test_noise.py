"""Whitening makes independent residuals of unit variance of the noise it describes."""

import numpy as np
import pytest

from disco_hw.gap.wheel_noise import WheelNoise, wheel_gains, whiten_wheels


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


def test_wheel_residuals_become_white():
    rng = np.random.default_rng(0)
    count = 4000
    noise = WheelNoise(0.02, 0.2, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6)
    speed = np.full((count, 2), 4.0)
    residual = simulated(noise, speed, rng)
    flags = np.arange(count) == 0
    gains = wheel_gains(noise, np.full(count, 0.02), speed, np.zeros(count), flags, np.ones(count, bool))
    white = whiten_wheels(residual, gains)[1:, 0]
    assert white.var() == pytest.approx(1.0, abs=0.08)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 0.05


def test_whitening_is_linear():
    rng = np.random.default_rng(1)
    speed = rng.uniform(0, 5, (300, 2))
    gains = wheel_gains(WheelNoise(), np.full(300, 0.02), speed, np.zeros(300), np.arange(300) == 0, np.ones(300, bool))
    a, b = rng.standard_normal((2, 300, 2))
    np.testing.assert_allclose(
        whiten_wheels(a + 2 * b, gains), whiten_wheels(a, gains) + 2 * whiten_wheels(b, gains), atol=1e-9
    )
