"""The noise of the sensors alone, from what needs no model: neighbouring samples, and poses of a robot that rests.

A model's own residuals say how far it is off, not how well poses are measured: what is missing would count as noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.noise.channels import BodyChannel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A Gaussian's standard deviation over the median of its absolute values.
_OF_MEDIAN = 1.4826
# Values further out than so many standard deviations are single jumps, and count as that much.
_CLIPPED_SIGMAS = 5.0
# Samples next to each other are comparable where their distances in time differ by no more than this ratio.
_UNEVEN = 2.0
_FEWEST = 20


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Standard deviations of a single pose (m per axis, rad) and of a single wheel speed (rad/s)."""

    position_m: float
    yaw_rad: float
    wheel_rad_s: float


def sensor_noise(channel: BodyChannel, p: Array) -> SensorNoise:
    """What single samples of a drive err by; `p`, a vector of the body, only says roughly where the wheels lead to.

    Of moving robots the smaller of two bounds: second differences of what poses are off the wheels' path, and third
    differences of the poses themselves, in which motion is nothing and noise is whole. Of resting ones the scatter
    about the middle of a rest, which shows slow noise too; the larger of both.
    """
    beside, measured = channel.raw_residual(p), channel.measured
    t_s, window, use = channel.samples.t_s, channel.window, channel.use
    moving = [
        _least(_second(t_s, beside[:, columns], window, use), _third(t_s, measured[:, columns], window, use))
        for columns in (slice(0, 2), slice(2, 3))
    ]
    resting = (np.abs(channel.drive.speed_rad_s).max(axis=1) < channel.settings.noise.rest_rad_s)[channel.samples.node]
    still = [
        _scatter(measured[:, columns], np.cumsum(np.diff(window + 1e6 * ~resting, prepend=-1.0) != 0), resting & use)
        for columns in (slice(0, 2), slice(2, 3))
    ]
    speed = channel.drive.speed_rad_s.mean(axis=1)[channel.samples.node]
    of_speed = _second(t_s, speed[:, None], window, use & ~resting)
    return SensorNoise(max(moving[0], still[0]), max(moving[1], still[1]), _sigma(of_speed))


def _second(t_s: Array, values: Array, window: NDArray[np.int64], use: Mask) -> Array:
    """What values (P, C) are off the line between their neighbours, in units of their own noise, (n, C)."""
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


def _least(*differences: Array) -> float:
    """The smallest of some bounds that enough samples give; 0 where none does."""
    return min((_sigma(each) for each in differences if each.shape[0] >= _FEWEST), default=0.0)


def _scatter(values: Array, rest: NDArray[np.int64], inside: Mask) -> float:
    """Standard deviation of values (P, C) about the middles of their rests; 0 where the robot hardly rests."""
    off = []
    for number in np.unique(rest[inside]):
        chosen = values[inside & (rest == number)]
        if chosen.shape[0] >= 5:
            off.append((chosen - np.median(chosen, axis=0)) * (chosen.shape[0] / (chosen.shape[0] - 1.0)) ** 0.5)
    stacked = np.concatenate(off) if off else np.empty((0, values.shape[1]))
    return _sigma(stacked) if stacked.shape[0] >= _FEWEST else 0.0


def _sigma(values: Array) -> float:
    """Standard deviation of values about 0, single jumps clipped."""
    if not values.size:
        return 0.0
    rough = _OF_MEDIAN * float(np.median(np.abs(values)))
    largest = _CLIPPED_SIGMAS * rough if rough > 0.0 else float(np.abs(values).max())
    return float(np.sqrt((np.clip(values, -largest, largest) ** 2).mean()))
