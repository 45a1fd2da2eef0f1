"""Noise of the poses under a right model: that of the pose sensor, and slip of the body.

A Kalman filter with the states error of x, y, yaw, slip velocity (forward, left, yaw rate) and correlated pose noise
turns the residuals of a window, whose start is unknown, into independent ones of unit variance. Its gains depend on
the measured motion only, so whitening is linear.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from disco_hw.jit import kernel_function, scalar_function

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Position and heading, slip, and the correlated noise of the poses: three of each.
STATES = 9
# Chosen: far above the noise of a pose, so that the first one decides.
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
        """Return the logarithms of all nine values, (9,)."""
        return np.asarray(np.log(astuple(self)))

    @classmethod
    def from_vector(cls, logs: Array) -> BodyNoise:
        """Return the noise whose logarithms, in the order of `vector`, are `logs` (9,)."""
        return cls(*np.exp(logs).tolist())


@dataclass(frozen=True, slots=True)
class BodyMotion:
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
    """The filter's transition (P, 9) by its entries, gain (P, 9, 3) and whitening (P, 3, 3) at every sample."""

    transition: Array
    gain: Array
    scale: Array
    restart: Mask
    use: Mask


@scalar_function
def _transit(
    t: Any, noise: Any, dt: float, dx: float, dy: float, cosine: float, sine: float, moving: float, speed: float,
    rate: float,
) -> None:  # fmt: skip
    """Compute the transition of errors to the next sample: x and y from yaw and slip, yaw from slip, decay of both."""
    forward = (noise[3] * moving + noise[7] * abs(speed)) * dt
    left = (noise[4] * moving + noise[7] * abs(speed)) * dt
    t[0], t[1], t[2] = -dy, cosine * forward, -sine * left
    t[3], t[4], t[5] = dx, sine * forward, cosine * left
    t[6] = (noise[5] * moving + noise[7] * abs(rate)) * dt
    t[7], t[8] = math.exp(-dt / noise[6]), math.exp(-dt / noise[8])


@scalar_function
def _begin(c: Any, noise: Any) -> None:
    """Covariance of a window's first sample."""
    c[:, :] = 0.0
    for i in range(3):
        pose = noise[1] if i == 2 else noise[0]
        c[i, i] = _START_M**2 if i < 2 else _START_RAD**2
        c[3 + i, 3 + i] = 1.0
        c[6 + i, 6 + i] = pose * pose


@scalar_function
def _spread(c: Any, t: Any, noise: Any) -> None:
    """Covariance of the next sample, of which nothing is known yet; what is zero in the transition is left out."""
    for j in range(9):
        c[0, j] += t[0] * c[2, j] + t[1] * c[3, j] + t[2] * c[4, j]
        c[1, j] += t[3] * c[2, j] + t[4] * c[3, j] + t[5] * c[4, j]
        c[2, j] += t[6] * c[5, j]
    for i in range(3):
        for j in range(9):
            c[3 + i, j] *= t[7]
            c[6 + i, j] *= t[8]
    for i in range(9):
        c[i, 0] += t[0] * c[i, 2] + t[1] * c[i, 3] + t[2] * c[i, 4]
        c[i, 1] += t[3] * c[i, 2] + t[4] * c[i, 3] + t[5] * c[i, 4]
        c[i, 2] += t[6] * c[i, 5]
        for j in range(3):
            c[i, 3 + j] *= t[7]
            c[i, 6 + j] *= t[8]
    for i in range(3):
        pose = noise[1] if i == 2 else noise[0]
        c[i, i] += 1e-12
        c[3 + i, 3 + i] += 1.0 - t[7] * t[7]
        c[6 + i, 6 + i] += pose * pose * (1.0 - t[8] * t[8])


@scalar_function
def _weigh(c: Any, stamp: float, vx: float, vy: float, rate: float, m: Any) -> float:
    """Whitening m (3, 3), lower, of the next surprise, and the logarithm of its determinant."""
    s = stamp * stamp
    s00 = c[0, 0] + c[6, 0] + c[0, 6] + c[6, 6] + s * vx * vx + 1e-10
    s11 = c[1, 1] + c[7, 1] + c[1, 7] + c[7, 7] + s * vy * vy + 1e-10
    s22 = c[2, 2] + c[8, 2] + c[2, 8] + c[8, 8] + s * rate * rate + 1e-10
    s10 = c[1, 0] + c[7, 0] + c[1, 6] + c[7, 6] + s * vy * vx
    s20 = c[2, 0] + c[8, 0] + c[2, 6] + c[8, 6] + s * rate * vx
    s21 = c[2, 1] + c[8, 1] + c[2, 7] + c[8, 7] + s * rate * vy
    l00 = math.sqrt(s00)
    l10, l20 = s10 / l00, s20 / l00
    l11 = math.sqrt(s11 - l10 * l10)
    l21 = (s21 - l20 * l10) / l11
    l22 = math.sqrt(s22 - l20 * l20 - l21 * l21)
    m[0, 0], m[1, 1], m[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    m[1, 0] = -l10 * m[0, 0] * m[1, 1]
    m[2, 1] = -l21 * m[1, 1] * m[2, 2]
    m[2, 0] = -(l20 * m[0, 0] + l21 * m[1, 0]) * m[2, 2]
    m[0, 1] = m[0, 2] = m[1, 2] = 0.0
    return -math.log(l00 * l11 * l22)


@scalar_function
def _learn(c: Any, m: Any, w: Any, gain: Any) -> None:
    """Gain (9, 3) of a sample, P H' S^-1 with S^-1 = m' m, and covariance c after it; w (3, 9) is scratch."""
    for i in range(9):
        h0, h1, h2 = c[0, i] + c[6, i], c[1, i] + c[7, i], c[2, i] + c[8, i]
        w[0, i] = m[0, 0] * h0
        w[1, i] = m[1, 0] * h0 + m[1, 1] * h1
        w[2, i] = m[2, 0] * h0 + m[2, 1] * h1 + m[2, 2] * h2
    for i in range(9):
        gain[i, 0] = m[0, 0] * w[0, i] + m[1, 0] * w[1, i] + m[2, 0] * w[2, i]
        gain[i, 1] = m[1, 1] * w[1, i] + m[2, 1] * w[2, i]
        gain[i, 2] = m[2, 2] * w[2, i]
    for i in range(9):
        a, b, d = w[0, i], w[1, i], w[2, i]
        for j in range(9):
            c[i, j] -= a * w[0, j] + b * w[1, j] + d * w[2, j]


@scalar_function
def _drift(e: Any, t: Any) -> None:
    """Propagate the expected errors `e` (9,) to the next sample, in place."""
    e[0] += t[0] * e[2] + t[1] * e[3] + t[2] * e[4]
    e[1] += t[3] * e[2] + t[4] * e[3] + t[5] * e[4]
    e[2] += t[6] * e[5]
    for i in range(3):
        e[3 + i] *= t[7]
        e[6 + i] *= t[8]


@scalar_function
def _surprise(e: Any, gain: Any, m: Any, x: float, y: float, yaw: float) -> tuple[float, float, float]:
    """Whitened difference of a residual from what was expected, which then learns from it."""
    a, b, c = x - e[0] - e[6], y - e[1] - e[7], yaw - e[2] - e[8]
    for i in range(9):
        e[i] += gain[i, 0] * a + gain[i, 1] * b + gain[i, 2] * c
    return m[0, 0] * a, m[1, 0] * a + m[1, 1] * b, m[2, 0] * a + m[2, 1] * b + m[2, 2] * c


@kernel_function
def _gains(
    noise: Array, dt: Array, dx: Array, dy: Array, cosine: Array, sine: Array, moving: Array, speed: Array,
    rate: Array, restart: Array, use: Array, transition: Array, gain: Array, scale: Array,
) -> None:  # fmt: skip
    c, w = np.zeros((9, 9)), np.zeros((3, 9))
    for k in range(dt.shape[0]):
        if restart[k]:
            transition[k] = 0.0
            _begin(c, noise)
        else:
            _transit(
                transition[k], noise, dt[k], dx[k], dy[k], cosine[k], sine[k], moving[k], speed[k], rate[k]
            )  # fmt: skip
            _spread(c, transition[k], noise)
        _weigh(c, noise[2], cosine[k] * speed[k], sine[k] * speed[k], rate[k], scale[k])
        if use[k]:
            _learn(c, scale[k], w, gain[k])
        else:
            gain[k] = 0.0


@kernel_function
def _likelihood(
    noise: Array, dt: Array, dx: Array, dy: Array, cosine: Array, sine: Array, moving: Array, speed: Array,
    rate: Array, restart: Array, use: Array, residual: Array, out: Array,
) -> float:  # fmt: skip
    c, w, gain, m = np.zeros((9, 9)), np.zeros((3, 9)), np.zeros((9, 3)), np.zeros((3, 3))
    t, e = np.zeros(9), np.zeros(9)
    total = 0.0
    for k in range(dt.shape[0]):
        if restart[k]:
            e[:] = 0.0
            _begin(c, noise)
        else:
            _transit(t, noise, dt[k], dx[k], dy[k], cosine[k], sine[k], moving[k], speed[k], rate[k])
            _spread(c, t, noise)
            _drift(e, t)
        out[k, 0] = out[k, 1] = out[k, 2] = 0.0
        if not use[k]:
            continue
        weight = _weigh(c, noise[2], cosine[k] * speed[k], sine[k] * speed[k], rate[k], m)
        _learn(c, m, w, gain)
        white = _surprise(e, gain, m, residual[k, 0], residual[k, 1], residual[k, 2])
        # The first sample of a window only says where it starts.
        if not restart[k]:
            out[k, 0], out[k, 1], out[k, 2] = white
            total += weight
    return total


@kernel_function
def _whiten(
    residual: Array, transition: Array, gain: Array, scale: Array, restart: Array, use: Array, out: Array
) -> None:
    e = np.zeros(9)
    for k in range(residual.shape[0]):
        if restart[k]:
            e[:] = 0.0
        else:
            _drift(e, transition[k])
        if use[k]:
            out[k, 0], out[k, 1], out[k, 2] = _surprise(
                e, gain[k], scale[k], residual[k, 0], residual[k, 1], residual[k, 2]
            )
        else:
            out[k, 0] = out[k, 1] = out[k, 2] = 0.0


def _along(motion: BodyMotion) -> tuple[Array | Mask, ...]:
    """Return the motion as the tuple of arrays that the kernels take, none of them a strided column of a table."""
    dx, dy = np.ascontiguousarray(motion.dx_m), np.ascontiguousarray(motion.dy_m)
    return (
        motion.dt_s, dx, dy, np.cos(motion.yaw_rad), np.sin(motion.yaw_rad), motion.moving, motion.speed_m_s,
        motion.yaw_rate_rad_s, motion.restart, motion.use,
    )  # fmt: skip


def body_gains(noise: BodyNoise, motion: BodyMotion) -> BodyGains:
    """Transition, gains and whitening for one motion."""
    count = motion.dt_s.size
    transition, gain, scale = np.empty((count, STATES)), np.empty((count, STATES, 3)), np.empty((count, 3, 3))
    _gains(np.exp(noise.vector()), *_along(motion), transition, gain, scale)
    return BodyGains(transition, gain, scale, motion.restart, motion.use)


def body_likelihood(motion: BodyMotion, residual: Array) -> Callable[[Array], tuple[Array, float]]:
    """For pose residuals (P, 3) a function of the logarithms of the noise (9,).

    It gives the whitened residuals (P, 3), 0 where none counts, and the sum of the logarithms of their weights: what a
    likelihood needs, in one go and without keeping the gains.
    """
    along = _along(motion)

    def at(logs: Array) -> tuple[Array, float]:
        out = np.empty(residual.shape)
        return out, float(_likelihood(np.exp(logs), *along, residual, out))

    return at


def whiten_body(residual: Array, gains: BodyGains) -> Array:
    """Independent residuals of unit variance (P, 3) of pose residuals (P, 3) in the world frame; 0 where not used."""
    out = np.empty(residual.shape)
    _whiten(residual, gains.transition, gains.gain, gains.scale, gains.restart, gains.use, out)
    return out
