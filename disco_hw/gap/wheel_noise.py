"""What is left of the wheels' angles when the model is right: quantisation, time stamps, wandering wheel speed.

A Kalman filter per wheel with three states, drift of the angle, quick and slow relative error of the speed, turns angle
residuals into independent ones of unit variance. Its gains depend on the measured speed only, so whitening is linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from disco_hw.model.jit import kernel_function

Array = NDArray[np.float64]

WANDER_S = 20.0
_START_VARIANCE = 0.04
_STEADY_S = 0.25
_FEWEST_STEADY = 3


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """Relative speed error (1) and its correlation time (s); reading error (rad); jitter of the encoder's and of the
    command's time stamps (s); drift of the angle (rad per square root of s); slow relative speed error (1), which
    wanders with `WANDER_S`.
    """

    relative: float = 0.015
    correlation_s: float = 0.15
    reading_rad: float = 1e-3
    stamp_s: float = 5e-4
    command_stamp_s: float = 1e-3
    drift_rad_sqrt_s: float = 1e-3
    wander: float = 6e-3

    def vector(self) -> Array:
        """Logarithms, (7,)."""
        values = (
            self.relative,
            self.correlation_s,
            self.reading_rad,
            self.stamp_s,
            self.command_stamp_s,
            self.drift_rad_sqrt_s,
            self.wander,
        )
        return np.asarray(np.log(np.array(values)))

    @classmethod
    def from_vector(cls, logs: Array) -> WheelNoise:
        """The inverse of `vector`."""
        return cls(*np.exp(logs).tolist())


@dataclass(frozen=True, slots=True)
class WheelGains:
    """Transition and gains of the filter at every sample and wheel."""

    decay: Array
    reach: Array
    gain: Array
    scale: Array
    restart: NDArray[np.bool_]
    use: NDArray[np.bool_]


@kernel_function
def _gains(
    logs: Array,
    dt: Array,
    speed: Array,
    steady: Array,
    jumps: Array,
    restart: Array,
    use: Array,
    decay: Array,
    reach: Array,
    gain: Array,
    scale: Array,
) -> None:
    relative, correlation, reading = math.exp(logs[0]), math.exp(logs[1]), math.exp(logs[2])
    stamp, command_stamp, drift, wander = math.exp(logs[3]), math.exp(logs[4]), math.exp(logs[5]), math.exp(logs[6])
    for side in range(2):
        # Covariance of angle drift (a), quick (q) and slow (s) error of the speed.
        aa = aq = as_ = qq = qs = ss = 0.0
        for k in range(dt.shape[0]):
            fast = abs(speed[k, side])
            keep, hold = math.exp(-dt[k] / correlation), math.exp(-dt[k] / WANDER_S)
            decay[k, 0], decay[k, 1] = keep, hold
            # Signed: a wheel that turns too fast does so ahead and back.
            reach[k, side, 0] = speed[k, side] * dt[k]
            reach[k, side, 1] = steady[k, side] * dt[k]
            if restart[k]:
                aa, aq, as_, qs = _START_VARIANCE, 0.0, 0.0, 0.0
                qq, ss = relative * relative, wander * wander
            else:
                go, far = reach[k, side, 0], reach[k, side, 1]
                aa += 2.0 * (go * aq + far * as_) + go * go * qq + 2.0 * go * far * qs + far * far * ss
                aa += drift * drift * dt[k] + command_stamp * command_stamp * jumps[k]
                aq, as_ = keep * (aq + go * qq + far * qs), hold * (as_ + go * qs + far * ss)
                qq = keep * keep * qq + relative * relative * (1.0 - keep * keep)
                ss = hold * hold * ss + wander * wander * (1.0 - hold * hold)
                qs *= keep * hold
            variance = aa + reading * reading + stamp * stamp * fast * fast
            scale[k, side] = 1.0 / math.sqrt(variance)
            if not use[k]:
                gain[k, side, 0] = gain[k, side, 1] = gain[k, side, 2] = 0.0
                continue
            ka, kq, ks = aa / variance, aq / variance, as_ / variance
            gain[k, side, 0], gain[k, side, 1], gain[k, side, 2] = ka, kq, ks
            qq -= kq * aq
            qs -= kq * as_
            ss -= ks * as_
            aq -= ka * aq
            as_ -= ka * as_
            aa -= ka * aa


@kernel_function
def _whiten(
    residual: Array,
    decay: Array,
    reach: Array,
    gain: Array,
    scale: Array,
    restart: Array,
    use: Array,
    out: Array,
) -> None:
    for side in range(2):
        drift = quick = slow = 0.0
        for k in range(residual.shape[0]):
            if restart[k]:
                drift = quick = slow = 0.0
            else:
                drift += reach[k, side, 0] * quick + reach[k, side, 1] * slow
                quick *= decay[k, 0]
                slow *= decay[k, 1]
            if not use[k]:
                out[k, side] = 0.0
                continue
            surprise = residual[k, side] - drift
            # The first sample after a restart only says where the angle starts.
            out[k, side] = 0.0 if restart[k] else surprise * scale[k, side]
            drift += gain[k, side, 0] * surprise
            quick += gain[k, side, 1] * surprise
            slow += gain[k, side, 2] * surprise


def wheel_gains(
    noise: WheelNoise,
    dt_s: Array,
    speed_rad_s: Array,
    jumps: Array,
    restart: NDArray[np.bool_],
    use: NDArray[np.bool_],
) -> WheelGains:
    """Gains for samples `dt_s` apart (E,) at measured speeds (E, 2), with squared command jumps between them (E,)."""
    count = dt_s.size
    decay, reach = np.empty((count, 2)), np.empty((count, 2, 2))
    # A slow error that acted on the measured speed itself would scale the very noise it is measured by.
    period_s = max(float(np.median(dt_s)), 1e-3) if count else 1.0
    half = max(round(_STEADY_S / period_s), _FEWEST_STEADY)
    steady = uniform_filter1d(speed_rad_s, 2 * half + 1, axis=0, mode="nearest") if count else speed_rad_s
    gain, scale = np.empty((count, 2, 3)), np.empty((count, 2))
    _gains(noise.vector(), dt_s, speed_rad_s, steady, jumps, restart, use, decay, reach, gain, scale)
    return WheelGains(decay, reach, gain, scale, restart, use)


def whiten_wheels(residual: Array, gains: WheelGains) -> Array:
    """Independent residuals of unit variance (E, 2) of angle residuals (E, 2); 0 where a sample is not used."""
    out = np.empty(residual.shape)
    _whiten(residual, gains.decay, gains.reach, gains.gain, gains.scale, gains.restart, gains.use, out)
    return out
