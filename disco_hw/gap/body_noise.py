"""What is left of the poses when the model is right: noise of the pose sensor and slip of the body.

A Kalman filter with the states error of x, y, yaw, slip velocity (forward, left, yaw rate) and correlated pose noise
turns the residuals of a window, whose start is unknown, into independent ones of unit variance. Its gains depend on
the measured motion only, so whitening is linear.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.model.jit import kernel_function

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STATES = 9
_START_M = 0.3
_START_RAD = 0.3


@dataclass(frozen=True, slots=True)
class BodyNoise:
    """Pose noise (m, rad) with its correlation time (s) and jitter of the time stamps (s); slip of a moving body.

    Slip velocity forward, left (m/s), yaw rate (rad/s), its correlation time (s), and the part in proportion to the
    speed: forward and left (1), yaw rate to yaw rate (1).
    """

    position_m: float = 0.005
    yaw_rad: float = 0.0087
    stamp_s: float = 1e-3
    slip_forward_m_s: float = 0.006
    slip_left_m_s: float = 0.006
    slip_yaw_rad_s: float = 0.02
    slip_correlation_s: float = 0.3
    relative: float = 0.003
    noise_correlation_s: float = 0.02

    def vector(self) -> Array:
        """Logarithms, (9,)."""
        values = (
            self.position_m,
            self.yaw_rad,
            self.stamp_s,
            self.slip_forward_m_s,
            self.slip_left_m_s,
            self.slip_yaw_rad_s,
            self.slip_correlation_s,
            self.relative,
            self.noise_correlation_s,
        )
        return np.asarray(np.log(np.array(values)))

    @classmethod
    def from_vector(cls, logs: Array) -> BodyNoise:
        """The inverse of `vector`."""
        return cls(*np.exp(logs).tolist())


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion between pose samples, all (P,): what the filter's transition needs.

    `dt_s` since the sample before; step in the world `dx_m`, `dy_m`; `yaw_rad`; `moving` from 0 at rest to 1; speed
    (m/s) and yaw rate (rad/s); `restart` begins a window; `use` is False for poses left out.
    """

    dt_s: Array
    dx_m: Array
    dy_m: Array
    yaw_rad: Array
    moving: Array
    speed_m_s: Array
    yaw_rate_rad_s: Array
    restart: Mask
    use: Mask


@dataclass(frozen=True, slots=True)
class BodyGains:
    """The filter's transition, gain and whitening at every sample."""

    transition: Array
    gain: Array
    scale: Array
    log_scale: Array
    restart: Mask
    use: Mask


@kernel_function
def _gains(  # noqa: PLR0912, PLR0915 - one recursion; cut in pieces it would only be slower
    logs: Array,
    dt: Array,
    dx: Array,
    dy: Array,
    yaw: Array,
    moving: Array,
    speed: Array,
    rate: Array,
    restart: Array,
    use: Array,
    transition: Array,
    gain: Array,
    scale: Array,
    log_scale: Array,
) -> None:
    pose = (math.exp(logs[0]), math.exp(logs[0]), math.exp(logs[1]))
    stamp, correlation, relative = math.exp(logs[2]), math.exp(logs[6]), math.exp(logs[7])
    slip = (math.exp(logs[3]), math.exp(logs[4]), math.exp(logs[5]))
    noise_correlation = math.exp(logs[8])
    covariance = np.zeros((9, 9))
    moved = np.zeros((9, 9))
    f = np.zeros((9, 9))
    s = np.zeros((3, 3))
    lower = np.zeros((3, 3))
    for k in range(dt.shape[0]):
        cosine, sine = math.cos(yaw[k]), math.sin(yaw[k])
        amount = (
            slip[0] * moving[k] + relative * abs(speed[k]),
            slip[1] * moving[k] + relative * abs(speed[k]),
            slip[2] * moving[k] + relative * abs(rate[k]),
        )
        f[:, :] = 0.0
        if restart[k]:
            covariance[:, :] = 0.0
            for i in range(3):
                covariance[i, i] = _START_M**2 if i < 2 else _START_RAD**2
                covariance[3 + i, 3 + i] = 1.0
                covariance[6 + i, 6 + i] = pose[i] ** 2
        else:
            keep, keep_noise = math.exp(-dt[k] / correlation), math.exp(-dt[k] / noise_correlation)
            for i in range(3):
                f[i, i] = 1.0
                f[3 + i, 3 + i] = keep
                f[6 + i, 6 + i] = keep_noise
            f[0, 2], f[1, 2] = -dy[k], dx[k]
            f[0, 3], f[0, 4] = cosine * amount[0] * dt[k], -sine * amount[1] * dt[k]
            f[1, 3], f[1, 4] = sine * amount[0] * dt[k], cosine * amount[1] * dt[k]
            f[2, 5] = amount[2] * dt[k]
            for i in range(9):
                for j in range(9):
                    total = 0.0
                    if i < 3:
                        for m in range(6):
                            total += f[i, m] * covariance[m, j]
                    else:
                        total = f[i, i] * covariance[i, j]
                    moved[i, j] = total
            for i in range(9):
                for j in range(9):
                    total = 0.0
                    if j < 3:
                        for m in range(6):
                            total += moved[i, m] * f[j, m]
                    else:
                        total = moved[i, j] * f[j, j]
                    covariance[i, j] = total
            for i in range(3):
                covariance[i, i] += 1e-12
                covariance[3 + i, 3 + i] += 1.0 - keep * keep
                covariance[6 + i, 6 + i] += pose[i] ** 2 * (1.0 - keep_noise * keep_noise)
        transition[k] = f
        vx, vy = cosine * speed[k], sine * speed[k]
        late = (vx, vy, rate[k])
        for i in range(3):
            for j in range(3):
                s[i, j] = (
                    covariance[i, j]
                    + covariance[6 + i, j]
                    + covariance[i, 6 + j]
                    + covariance[6 + i, 6 + j]
                    + stamp * stamp * late[i] * late[j]
                )
            s[i, i] += 1e-10
        # Cholesky factor of S and its inverse.
        l00 = math.sqrt(s[0, 0])
        l10, l20 = s[1, 0] / l00, s[2, 0] / l00
        l11 = math.sqrt(s[1, 1] - l10 * l10)
        l21 = (s[2, 1] - l20 * l10) / l11
        l22 = math.sqrt(s[2, 2] - l20 * l20 - l21 * l21)
        lower[0, 0], lower[1, 1], lower[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
        lower[1, 0] = -l10 * lower[0, 0] * lower[1, 1]
        lower[2, 1] = -l21 * lower[1, 1] * lower[2, 2]
        lower[2, 0] = -(l20 * lower[0, 0] + l21 * lower[1, 0]) * lower[2, 2]
        lower[0, 1] = lower[0, 2] = lower[1, 2] = 0.0
        scale[k] = lower
        log_scale[k] = -math.log(l00) - math.log(l11) - math.log(l22)
        gain[k] = 0.0
        if not use[k]:
            continue
        # Gain P H' S^-1 with S^-1 = lower' lower.
        for i in range(9):
            h = (
                covariance[i, 0] + covariance[i, 6],
                covariance[i, 1] + covariance[i, 7],
                covariance[i, 2] + covariance[i, 8],
            )
            w0 = lower[0, 0] * h[0]
            w1 = lower[1, 0] * h[0] + lower[1, 1] * h[1]
            w2 = lower[2, 0] * h[0] + lower[2, 1] * h[1] + lower[2, 2] * h[2]
            moved[i, 0], moved[i, 1], moved[i, 2] = w0, w1, w2
            gain[k, i, 0] = lower[0, 0] * w0 + lower[1, 0] * w1 + lower[2, 0] * w2
            gain[k, i, 1] = lower[1, 1] * w1 + lower[2, 1] * w2
            gain[k, i, 2] = lower[2, 2] * w2
        for i in range(9):
            for j in range(9):
                covariance[i, j] -= moved[i, 0] * moved[j, 0] + moved[i, 1] * moved[j, 1] + moved[i, 2] * moved[j, 2]


@kernel_function
def _whiten(
    residual: Array, transition: Array, gain: Array, scale: Array, restart: Array, use: Array, out: Array
) -> None:
    e = np.zeros(9)
    for k in range(residual.shape[0]):
        if restart[k]:
            e[:] = 0.0
        else:
            f = transition[k]
            x = e[0] + f[0, 2] * e[2] + f[0, 3] * e[3] + f[0, 4] * e[4]
            y = e[1] + f[1, 2] * e[2] + f[1, 3] * e[3] + f[1, 4] * e[4]
            yaw = e[2] + f[2, 5] * e[5]
            e[0], e[1], e[2] = x, y, yaw
            for i in range(3, 9):
                e[i] *= f[i, i]
        if not use[k]:
            out[k, 0] = out[k, 1] = out[k, 2] = 0.0
            continue
        a = residual[k, 0] - e[0] - e[6]
        b = residual[k, 1] - e[1] - e[7]
        c = residual[k, 2] - e[2] - e[8]
        m = scale[k]
        out[k, 0] = m[0, 0] * a
        out[k, 1] = m[1, 0] * a + m[1, 1] * b
        out[k, 2] = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
        for i in range(9):
            e[i] += gain[k, i, 0] * a + gain[k, i, 1] * b + gain[k, i, 2] * c


def body_gains(noise: BodyNoise, motion: Motion) -> BodyGains:
    """Transition, gains and whitening for one motion."""
    count = motion.dt_s.size
    transition, gain = np.zeros((count, STATES, STATES)), np.zeros((count, STATES, 3))
    scale, log_scale = np.zeros((count, 3, 3)), np.zeros(count)
    _gains(
        noise.vector(),
        motion.dt_s,
        motion.dx_m,
        motion.dy_m,
        motion.yaw_rad,
        motion.moving,
        motion.speed_m_s,
        motion.yaw_rate_rad_s,
        motion.restart,
        motion.use,
        transition,
        gain,
        scale,
        log_scale,
    )
    return BodyGains(transition, gain, scale, log_scale, motion.restart, motion.use)


def whiten_body(residual: Array, gains: BodyGains) -> Array:
    """Independent residuals of unit variance (P, 3) of pose residuals (P, 3) in the world frame; 0 where not used."""
    out = np.empty(residual.shape)
    _whiten(residual, gains.transition, gains.gain, gains.scale, gains.restart, gains.use, out)
    return out
