"""Noise of the wheel angles under a right model: quantisation, time stamps, drift of the wheel speed.

A Kalman filter per wheel with three states, drift of the angle, quick and slow relative error of the speed, turns angle
residuals into independent ones of unit variance. Its gains depend on the measured speed only, so whitening is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from disco_hw.gap.settings import DRIFT_S
from disco_hw.jit import kernel_function, scalar_function

Array = NDArray[np.float64]

# Chosen: 0.2 rad, far above the noise of an encoder, so that the first count decides.
_START_VARIANCE = 0.04


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """Noise of the wheels' speeds and angles, and of the time stamps of encoders and commands.

    Relative speed error (1) and its correlation time (s); reading error (rad); jitter of the encoder's and of the
    command's time stamps (s); drift of the angle (rad per square root of s); slow relative speed error (1), which
    drifts with `DRIFT_S`.
    """

    relative: float = 0.015
    correlation_s: float = 0.15
    reading_rad: float = 1e-3
    stamp_s: float = 5e-4
    command_stamp_s: float = 1e-3
    drift_rad_sqrt_s: float = 1e-3
    drift_std: float = 6e-3

    def vector(self) -> Array:
        """Return the logarithms of all seven values, (7,)."""
        return np.asarray(np.log(astuple(self)))

    @classmethod
    def from_vector(cls, logs: Array) -> WheelNoise:
        """Return the noise whose logarithms, in the order of `vector`, are `logs` (7,)."""
        return cls(*np.exp(logs).tolist())


@dataclass(frozen=True, slots=True)
class WheelMotion:
    """Inputs of the filter's transition: how the wheels were driven between samples.

    `dt_s` (E,) since the sample before, measured `speed_rad_s` (E, 2), `expected_rad_s` (E, 2) that a model gives,
    squared `jumps` of the command since then (E,); `restart` begins a run; `use` is False for samples left out.
    """

    dt_s: Array
    speed_rad_s: Array
    expected_rad_s: Array
    jumps: Array
    restart: NDArray[np.bool_]
    use: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class WheelGains:
    """Transition and gains of the filter at every sample and wheel."""

    decay: Array
    reach: Array
    gain: Array
    scale: Array
    restart: NDArray[np.bool_]
    use: NDArray[np.bool_]


@scalar_function
def _spread(c: Any, noise: Any, go: float, far: float, keep: float, hold: float, dt: float, jumps: float) -> Any:
    """Covariance of angle drift, quick and slow error of the speed (aa, aq, as, qq, qs, ss) at the next sample."""
    aa, aq, as_, qq, qs, ss = c
    aa += 2.0 * (go * aq + far * as_) + go * go * qq + 2.0 * go * far * qs + far * far * ss
    aa += noise[5] * noise[5] * dt + noise[4] * noise[4] * jumps
    aq, as_ = keep * (aq + go * qq + far * qs), hold * (as_ + go * qs + far * ss)
    qq = keep * keep * qq + noise[0] * noise[0] * (1.0 - keep * keep)
    ss = hold * hold * ss + noise[6] * noise[6] * (1.0 - hold * hold)
    return aa, aq, as_, qq, qs * keep * hold, ss


@scalar_function
def _begin(noise: Any) -> Any:
    """Covariance of a run's first sample."""
    return _START_VARIANCE, 0.0, 0.0, noise[0] * noise[0], 0.0, noise[6] * noise[6]


@scalar_function
def _estimate(c: Any, ka: float, kq: float, ks: float) -> Any:
    """Covariance after a sample with these gains."""
    aa, aq, as_, qq, qs, ss = c
    return aa - ka * aa, aq - ka * aq, as_ - ka * as_, qq - kq * aq, qs - kq * as_, ss - ks * as_


@kernel_function
def _gains(
    noise: Array, dt: Array, speed: Array, expected: Array, jumps: Array, restart: Array, use: Array, decay: Array,
    reach: Array, gain: Array, scale: Array,
) -> None:  # fmt: skip
    for side in range(2):
        c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        for k in range(dt.shape[0]):
            keep, hold = math.exp(-dt[k] / noise[1]), math.exp(-dt[k] / DRIFT_S)
            decay[k, 0], decay[k, 1] = keep, hold
            # Signed: a wheel that turns too fast does so ahead and back.
            go, far = speed[k, side] * dt[k], expected[k, side] * dt[k]
            reach[k, side, 0], reach[k, side, 1] = go, far
            c = _begin(noise) if restart[k] else _spread(c, noise, go, far, keep, hold, dt[k], jumps[k])
            variance = c[0] + noise[2] * noise[2] + (noise[3] * speed[k, side]) ** 2
            scale[k, side] = 1.0 / math.sqrt(variance)
            if use[k]:
                ka, kq, ks = c[0] / variance, c[1] / variance, c[2] / variance
                gain[k, side, 0], gain[k, side, 1], gain[k, side, 2] = ka, kq, ks
                c = _estimate(c, ka, kq, ks)
            else:
                gain[k, side, 0] = gain[k, side, 1] = gain[k, side, 2] = 0.0


@kernel_function
def _likelihood(
    noise: Array, dt: Array, speed: Array, expected: Array, jumps: Array, restart: Array, use: Array, counted: Array,
    residual: Array, out: Array,
) -> float:  # fmt: skip
    total = 0.0
    for side in range(2):
        c = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        drift = fast = slow = 0.0
        before, keep, hold = -1.0, 0.0, 0.0
        for k in range(dt.shape[0]):
            if dt[k] != before:
                before, keep, hold = dt[k], math.exp(-dt[k] / noise[1]), math.exp(-dt[k] / DRIFT_S)
            if restart[k]:
                c = _begin(noise)
                drift = fast = slow = 0.0
            else:
                go, far = speed[k, side] * dt[k], expected[k, side] * dt[k]
                c = _spread(c, noise, go, far, keep, hold, dt[k], jumps[k])
                drift += go * fast + far * slow
                fast *= keep
                slow *= hold
            out[k, side] = 0.0
            if not use[k]:
                continue
            variance = c[0] + noise[2] * noise[2] + (noise[3] * speed[k, side]) ** 2
            surprise = residual[k, side] - drift
            if counted[k]:
                out[k, side] = surprise / math.sqrt(variance)
                total -= 0.5 * math.log(variance)
            ka, kq, ks = c[0] / variance, c[1] / variance, c[2] / variance
            drift += ka * surprise
            fast += kq * surprise
            slow += ks * surprise
            c = _estimate(c, ka, kq, ks)
    return total


@kernel_function
def _whiten(
    residual: Array, decay: Array, reach: Array, gain: Array, scale: Array, restart: Array, use: Array, out: Array
) -> None:
    # Both wheels in one loop: each one's filter waits for itself, and neither for the other.
    drift = fast = slow = other_drift = other_fast = other_slow = 0.0
    for k in range(residual.shape[0]):
        if restart[k]:
            drift = fast = slow = other_drift = other_fast = other_slow = 0.0
        else:
            drift += reach[k, 0, 0] * fast + reach[k, 0, 1] * slow
            other_drift += reach[k, 1, 0] * other_fast + reach[k, 1, 1] * other_slow
            fast *= decay[k, 0]
            slow *= decay[k, 1]
            other_fast *= decay[k, 0]
            other_slow *= decay[k, 1]
        if not use[k]:
            out[k, 0] = out[k, 1] = 0.0
            continue
        surprise, other = residual[k, 0] - drift, residual[k, 1] - other_drift
        # The first sample after a restart only says where the angle starts.
        out[k, 0] = 0.0 if restart[k] else surprise * scale[k, 0]
        out[k, 1] = 0.0 if restart[k] else other * scale[k, 1]
        drift += gain[k, 0, 0] * surprise
        fast += gain[k, 0, 1] * surprise
        slow += gain[k, 0, 2] * surprise
        other_drift += gain[k, 1, 0] * other
        other_fast += gain[k, 1, 1] * other
        other_slow += gain[k, 1, 2] * other


def mean_speeds(dt_s: Array, speed_rad_s: Array, span_s: float, fewest: int = 0) -> Array:
    """Mean of measured speeds (E, 2) over so long either side, and over so many samples at least."""
    if not dt_s.size:
        return speed_rad_s
    half = max(round(span_s / max(float(np.median(dt_s)), 1e-3)), fewest)
    return np.asarray(uniform_filter1d(speed_rad_s, 2 * half + 1, axis=0, mode="nearest"))


def wheel_gains(noise: WheelNoise, motion: WheelMotion) -> WheelGains:
    """Gains for one motion of the wheels."""
    count = motion.dt_s.size
    decay, reach = np.empty((count, 2)), np.empty((count, 2, 2))
    gain, scale = np.empty((count, 2, 3)), np.empty((count, 2))
    _gains(np.exp(noise.vector()), *_along(motion), decay, reach, gain, scale)
    return WheelGains(decay, reach, gain, scale, motion.restart, motion.use)


def wheel_likelihood(
    motion: WheelMotion, counted: NDArray[np.bool_], residual: Array
) -> Callable[[Array], tuple[Array, float]]:
    """For angle residuals (E, 2), of which some are `counted` (E,), a function of the logarithms of the noise (7,).

    It gives the whitened residuals (E, 2), 0 where none counts, and the sum of the logarithms of their weights: what a
    likelihood needs, in one go and without keeping the gains.
    """
    along = _along(motion)

    def at(logs: Array) -> tuple[Array, float]:
        out = np.empty(residual.shape)
        return out, float(_likelihood(np.exp(logs), *along, counted, residual, out))

    return at


def _along(motion: WheelMotion) -> tuple[Array | NDArray[np.bool_], ...]:
    """Return the motion of the wheels as the tuple of arrays that the kernels take."""
    return motion.dt_s, motion.speed_rad_s, motion.expected_rad_s, motion.jumps, motion.restart, motion.use


def whiten_wheels(residual: Array, gains: WheelGains) -> Array:
    """Independent residuals of unit variance (E, 2) of angle residuals (E, 2); 0 where a sample is not used."""
    out = np.empty(residual.shape)
    _whiten(residual, gains.decay, gains.reach, gains.gain, gains.scale, gains.restart, gains.use, out)
    return out
