"""Noise of the wheels and of the body, estimated from the log.

The noise of a channel comes from the residuals of the richest model, and is then held for every comparison. That of the
sensors alone needs no model: it comes from neighbouring samples, and from poses of a robot that rests. In a model's own
residuals, what is missing would count as noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.noise.body_noise import BodyNoise, body_likelihood
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.noise.wheel_noise import WheelNoise, wheel_likelihood, whiten_wheels
from disco_hw.gap.settings import OF_MEDIAN, NoiseSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Samples next to each other are comparable where their distances in time differ by no more than this ratio.
_UNEVEN = 2.0
_FEWEST = 20
_READING, _COMMAND_STAMP = 2, 4


def _huber(white: Array, limit: float) -> float:
    """Sum of squares of whitened residuals that grow linearly beyond `limit`."""
    flat = white.ravel()
    beyond = np.abs(flat)
    beyond = beyond[beyond > limit] - limit
    return float(flat @ flat - beyond @ beyond)


def _fitted(
    mismatch: Callable[[Array], float], usual: Array, begin: Array, low: Array, high: Array, most: int,
    settings: NoiseSettings,
) -> Array:  # fmt: skip
    """Logarithms of the noise of least mismatch from `low` to `high`, after `most` steps.

    A weak Gaussian prior about the `usual` ones keeps those there of which the log says nothing.
    """
    step = settings.difference_step

    def objective(logs: Array) -> float:
        return mismatch(logs) + 0.5 * float((((logs - usual) / settings.prior_sd) ** 2).sum())

    def slope(logs: Array) -> Array:
        # Central: a one-sided difference this wide would end the search some way off.
        out = np.empty(logs.size)
        for k in range(logs.size):
            ahead, behind = logs.copy(), logs.copy()
            ahead[k], behind[k] = min(logs[k] + step, high[k]), max(logs[k] - step, low[k])
            out[k] = (objective(ahead) - objective(behind)) / max(ahead[k] - behind[k], 1e-9)
        return out

    bounds, options = list(zip(low, high, strict=True)), {"maxiter": most, "ftol": 3e-6}
    found = minimize(objective, begin, jac=slope, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x)


def largest_command_jitter_s(drive: GriddedDrive) -> float:
    """Return the largest plausible jitter of the commands (s), from the scatter of the encoder's time stamps.

    More than that is a response that the model lacks, and must not count as noise.
    """
    settings = drive.settings.noise
    scattered_s = settings.command_jitter_ratio * drive.stamp_scatter_s
    return scattered_s + settings.command_jitter_share * drive.encoder_period_s


def _robust(likelihood: Callable[[Array], tuple[Array, float]], huber: float) -> Callable[[Array], float]:
    """Minus the log likelihood in which whitened residuals beyond `huber` grow linearly."""

    def mismatch(logs: Array) -> float:
        white, weight = likelihood(logs)
        return 0.5 * _huber(white, huber) - weight

    return mismatch


def wheel_mismatch(channel: WheelChannel, raw: Array) -> Callable[[Array], float]:
    """Minus the robust log likelihood of what a model leaves of the angles (E, 2), by logarithms of the noise (7,)."""
    motion = channel.motion
    # A wheel at rest reads the same however coarse its encoder is, and would speak for readings without error.
    counted = motion.use & ~motion.restart & (np.abs(motion.speed_rad_s).max(axis=1) > channel.settings.grid.rest_rad_s)
    return _robust(wheel_likelihood(motion, counted, raw), channel.settings.noise.huber)


def fit_wheel_noise(channel: WheelChannel, raw: Array) -> WheelNoise:
    """Noise of the wheels by maximum likelihood of what a model leaves of the angles, (E, 2)."""
    drive, settings = channel.drive, channel.settings.noise
    start = channel.noise.vector()
    # A speed that may be wrong by any amount for any time would explain wheels that do not turn at all.
    most = np.minimum(start + 5.0, WheelNoise(*settings.largest_wheel_noise).vector())
    most[_COMMAND_STAMP] = min(most[_COMMAND_STAMP], math.log(largest_command_jitter_s(drive)))
    begin = np.minimum(start, most)
    least = begin - 5.0
    if drive.quantum_rad > 0.0:
        least[_READING] = max(least[_READING], math.log(drive.quantum_rad / math.sqrt(12.0)))
    mismatch, begin = wheel_mismatch(channel, raw), np.maximum(begin, least)
    return WheelNoise.from_vector(_fitted(mismatch, start, begin, least, most, settings.wheel_iterations, settings))


def fit_body_noise(channel: BodyChannel, p: Array, extra: Array | None = None, iterations: int = 15) -> BodyNoise:
    """Noise of poses and body by maximum likelihood at a parameter vector and what unnamed terms add."""
    settings = channel.settings.noise
    start = channel.noise.vector()
    mismatch = _robust(body_likelihood(channel.motion(), channel.raw_residual(p, extra)), settings.huber)
    return BodyNoise.from_vector(_fitted(mismatch, start, start, start - 5.0, start + 5.0, iterations, settings))


def without_outliers(channel: BodyChannel, p: Array, extra: Array | None = None) -> BodyChannel:
    """Return the channel without poses whose whitened residual exceeds the limit for outliers.

    The search is repeated, three times at most, until none is left or more than a tenth of the poses would go.
    """
    for _ in range(3):
        white = channel.whitened(p, extra)
        wild = channel.use & (np.abs(white).max(axis=1) > channel.settings.noise.outlier)
        # A pose that jumps makes its successors look wild too: only the first of a row goes, then look again.
        wild &= ~np.concatenate([[False], wild[:-1]])
        if not wild.any() or wild.sum() > 0.1 * channel.use.sum():
            break
        channel = channel.with_noise(channel.noise, use=channel.use & ~wild)
    return channel


def local_weight(white: Array, use: NDArray[np.bool_], settings: NoiseSettings) -> Array:
    """Weights that bring stretches and samples with larger residuals than the noise model's down to its size.

    `white` (S, k) whitened, not weighted; the local scale is the mean square over `2 smooth_samples + 1` samples.
    """
    clipped = np.minimum(white**2, 16.0) * use[:, None]
    window = np.ones(2 * settings.smooth_samples + 1)
    amount = np.convolve(use.astype(float), window, "same")
    weights = np.empty_like(white)
    for side in range(white.shape[1]):
        local = np.convolve(clipped[:, side], window, "same") / np.maximum(amount, 1.0)
        weights[:, side] = 1.0 / np.sqrt(np.maximum(local / settings.poor_fit, 1.0))
    tamed = np.abs(white) * weights
    return np.asarray(weights * np.minimum(1.0, settings.huber / np.maximum(tamed, 1e-9)))


def learn_wheel_noise(channel: WheelChannel, raw: Array) -> WheelChannel:
    """Return the channel with noise estimated from residuals `raw` (E, 2), and weights for noisier stretches."""
    channel = channel.with_noise(fit_wheel_noise(channel, raw))
    white = whiten_wheels(raw, channel.gains)
    wild = channel.gains.use & (np.abs(white).max(axis=1) > 2.0 * channel.settings.noise.outlier)
    if 0 < wild.sum() < 0.02 * wild.size:
        channel = channel.with_noise(channel.noise, ~wild)
        white = whiten_wheels(raw, channel.gains)
    return replace(channel, weight=local_weight(white, channel.gains.use, channel.settings.noise))


def learn_body_noise(channel: BodyChannel, p: Array, extra: Array | None = None, iterations: int = 15) -> BodyChannel:
    """Return the channel with noise estimated at `p`, without outliers, and with weights for noisier stretches."""
    channel = without_outliers(replace(channel, geometry=p.copy()).with_noise(channel.noise), p, extra)
    channel = channel.with_noise(fit_body_noise(channel, p, extra, iterations))
    channel = without_outliers(channel, p, extra)
    return replace(channel, weight=local_weight(channel.whitened(p, extra), channel.use, channel.settings.noise))


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Standard deviations of a single pose (m per axis, rad) and of a single wheel speed (rad/s)."""

    position_m: float
    yaw_rad: float
    wheel_rad_s: float


def sensor_noise(channel: BodyChannel, p: Array) -> SensorNoise:
    """Estimate the noise of single samples; `p`, a vector of the body, is needed only for a rough path of the wheels.

    For a moving robot it is the smaller of two bounds: second differences of poses against the wheels' path, and third
    differences of the poses themselves, in which no motion is left. For a resting one it is the scatter about the
    middle of a rest, which shows slow noise too. The larger of moving and resting counts.
    """
    raw, measured = channel.raw_residual(p), channel.measured
    t_s, window, use = channel.samples.t_s, channel.window, channel.use
    outlier = channel.settings.noise.outlier
    resting = (np.abs(channel.drive.speed_rad_s).max(axis=1) < channel.settings.grid.rest_rad_s)[channel.samples.node]
    rest = np.cumsum(np.diff(window + 1e6 * ~resting, prepend=-1.0) != 0)

    def of_poses(columns: slice) -> float:
        off, poses = raw[:, columns], measured[:, columns]
        moving = _least(outlier, _second(t_s, off, window, use), _third(t_s, poses, window, use))
        return max(moving, _scatter(outlier, poses, rest, resting & use))

    speed = channel.drive.speed_rad_s.mean(axis=1)[channel.samples.node]
    of_speed = _second(t_s, speed[:, None], window, use & ~resting)
    return SensorNoise(of_poses(slice(0, 2)), of_poses(slice(2, 3)), _sigma(outlier, of_speed))


def _second(t_s: Array, values: Array, window: NDArray[np.int64], use: Mask) -> Array:
    """Return distances of values (P, C) from the line between their neighbours, scaled to their own noise, (n, C)."""
    before, after = t_s[1:-1] - t_s[:-2], t_s[2:] - t_s[1:-1]
    good = (window[:-2] == window[2:]) & use[:-2] & use[1:-1] & use[2:] & (before > 0.0) & (after > 0.0)
    good &= np.maximum(before, after) < _UNEVEN * np.minimum(before, after)
    share = (after / np.maximum(before + after, 1e-9))[good, None]
    low, mid, high = values[:-2][good], values[1:-1][good], values[2:][good]
    return np.asarray((mid - share * low - (1.0 - share) * high) / np.sqrt(1.0 + share**2 + (1.0 - share) ** 2))


def _third(t_s: Array, values: Array, window: NDArray[np.int64], use: Mask) -> Array:
    """Third differences of evenly spaced values (P, C), in units of their own noise, (n, C)."""
    step = np.diff(t_s)
    spans = np.column_stack([step[:-2], step[1:-1], step[2:]])
    good = (window[:-3] == window[3:]) & use[:-3] & use[1:-2] & use[2:-1] & use[3:]
    good &= spans.max(axis=1) < 1.2 * np.maximum(spans.min(axis=1), 1e-9)
    return np.asarray(np.diff(values, 3, axis=0)[good] / 20.0**0.5)


def _least(outlier: float, *differences: Array) -> float:
    """Return the smallest standard deviation of those arrays that have enough samples; 0 where none has."""
    return min((_sigma(outlier, each) for each in differences if each.shape[0] >= _FEWEST), default=0.0)


def _scatter(outlier: float, values: Array, rest: NDArray[np.int64], inside: Mask) -> float:
    """Return the standard deviation of values (P, C) about the median of each rest; 0 if the robot hardly rests."""
    off = []
    for number in np.unique(rest[inside]):
        chosen = values[inside & (rest == number)]
        if chosen.shape[0] >= 5:
            off.append((chosen - np.median(chosen, axis=0)) * (chosen.shape[0] / (chosen.shape[0] - 1.0)) ** 0.5)
    stacked = np.concatenate(off) if off else np.empty((0, values.shape[1]))
    return _sigma(outlier, stacked) if stacked.shape[0] >= _FEWEST else 0.0


def _sigma(outlier: float, values: Array) -> float:
    """Return the standard deviation of values about 0, with single jumps clipped at `outlier` of them."""
    if not values.size:
        return 0.0
    rough = OF_MEDIAN * float(np.median(np.abs(values)))
    largest = outlier * rough if rough > 0.0 else float(np.abs(values).max())
    return float(np.sqrt((np.clip(values, -largest, largest) ** 2).mean()))
