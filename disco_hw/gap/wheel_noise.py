"""What is left of the wheels' angles when the model is right: quantisation, time stamps, wandering wheel speed.

A Kalman filter per wheel with two states, drift of the angle and relative error of the speed, turns angle residuals
into independent ones of unit variance. Its gains depend on the measured speed only, so whitening is linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

_START_VARIANCE = 0.04


@dataclass(frozen=True, slots=True)
class WheelNoise:
    """Relative speed error (1) and its correlation time (s); reading error (rad); jitter of the encoder's and of the
    command's time stamps (s); drift of the angle (rad per square root of s).
    """

    relative: float = 0.015
    correlation_s: float = 0.15
    reading_rad: float = 1e-3
    stamp_s: float = 5e-4
    command_stamp_s: float = 1e-3
    drift_rad_sqrt_s: float = 1e-3

    def vector(self) -> Array:
        """Logarithms, (6,)."""
        values = (
            self.relative,
            self.correlation_s,
            self.reading_rad,
            self.stamp_s,
            self.command_stamp_s,
            self.drift_rad_sqrt_s,
        )
        return np.log(np.array(values))

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


def _compiled(function: Any) -> Any:
    return njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})(function)


@_compiled
def _gains(
    logs: Array,
    dt: Array,
    speed: Array,
    jumps: Array,
    restart: Array,
    use: Array,
    decay: Array,
    reach: Array,
    gain: Array,
    scale: Array,
) -> None:
    relative, correlation, reading, stamp, command_stamp, drift = (
        math.exp(logs[0]),
        math.exp(logs[1]),
        math.exp(logs[2]),
        math.exp(logs[3]),
        math.exp(logs[4]),
        math.exp(logs[5]),
    )
    for side in range(2):
        a = b = c = 0.0
        for k in range(dt.shape[0]):
            fast = abs(speed[k, side])
            keep = math.exp(-dt[k] / correlation)
            decay[k] = keep
            reach[k, side] = fast * dt[k]
            if restart[k]:
                a, b, c = _START_VARIANCE, 0.0, relative * relative
            else:
                go = reach[k, side]
                a = a + 2.0 * go * b + go * go * c + drift * drift * dt[k] + command_stamp * command_stamp * jumps[k]
                b = keep * (b + go * c)
                c = keep * keep * c + relative * relative * (1.0 - keep * keep)
            s = a + reading * reading + stamp * stamp * fast * fast
            scale[k, side] = 1.0 / math.sqrt(s)
            if not use[k]:
                gain[k, side, 0] = gain[k, side, 1] = 0.0
                continue
            k0, k1 = a / s, b / s
            gain[k, side, 0], gain[k, side, 1] = k0, k1
            c -= k1 * b
            b -= k1 * a
            a -= k0 * a


@_compiled
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
        drift = error = 0.0
        for k in range(residual.shape[0]):
            if restart[k]:
                drift, error = 0.0, 0.0
            else:
                drift += reach[k, side] * error
                error *= decay[k]
            if not use[k]:
                out[k, side] = 0.0
                continue
            surprise = residual[k, side] - drift
            # The first sample after a restart only says where the angle starts.
            out[k, side] = 0.0 if restart[k] else surprise * scale[k, side]
            drift += gain[k, side, 0] * surprise
            error += gain[k, side, 1] * surprise


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
    decay, reach = np.empty(count), np.empty((count, 2))
    gain, scale = np.empty((count, 2, 2)), np.empty((count, 2))
    _gains(noise.vector(), dt_s, speed_rad_s, jumps, restart, use, decay, reach, gain, scale)
    return WheelGains(decay, reach, gain, scale, restart, use)


def whiten_wheels(residual: Array, gains: WheelGains) -> Array:
    """Independent residuals of unit variance (E, 2) of angle residuals (E, 2); 0 where a sample is not used."""
    out = np.empty(residual.shape)
    _whiten(residual, gains.decay, gains.reach, gains.gain, gains.scale, gains.restart, gains.use, out)
    return out
