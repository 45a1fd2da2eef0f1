"""What is still missing after naming, regime by regime: a stand-in of the right family and the wrong form leaves it.

The accepted set is compared with the richest model of its channel, from which the noise was learnt: where that one
still gains far more than its many parameters buy, in several blocks of time, something is left.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.noise.noise_fit import largest_command_jitter_s
from disco_hw.gap.report.regimes import masks
from disco_hw.gap.search.channel_search import ChannelResult

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LOUDER = 1.1
_CLEAR_SIGMAS = 3.0
_NATS_EACH = 1.0
_LEAST_NATS = 20.0
_FEWEST = 40
_FEWEST_BLOCKS = 4
_MOST_REGIMES = 3
_AT_BOUND = 0.9


def remaining_disagreements(found: ChannelResult) -> list[str]:
    """Sentences on what a channel's accepted set leaves, the loudest regime first; none where nothing is left."""
    channel = found.channel
    is_wheels = isinstance(channel, WheelChannel)
    name = "command_to_wheel" if is_wheels else "wheel_to_body"
    out = [f"{name}: {regime} still disagrees: {times:.1f} times the noise" for times, regime in loud_regimes(found)]
    if isinstance(channel, WheelChannel):
        drive = channel.drive
        if channel.noise.command_stamp_s > _AT_BOUND * largest_command_jitter_s(drive):
            out.append(
                f"{name}: speeding up and braking still disagree: as if commands came "
                f"{1e3 * channel.noise.command_stamp_s:.0f} ms early or late at random, the encoder's time stamps "
                f"scatter by {1e3 * drive.stamp_scatter_s:.1f} ms"
            )
    return out


def loud_regimes(found: ChannelResult) -> list[tuple[float, str]]:
    """Root mean square of what is left over the noise's, and name, of regimes in which something is left."""
    channel = found.channel
    if found.richest is None:
        return []
    samples = channel.drive.encoder if isinstance(channel, WheelChannel) else channel.samples
    use = channel.gains.use if isinstance(channel, WheelChannel) else channel.use
    width = found.richest.size // use.size
    now = (found.fit.residual.reshape(-1, width) ** 2).sum(axis=1)
    best = (found.richest.reshape(-1, width) ** 2).sum(axis=1)
    price = _LEAST_NATS + _NATS_EACH * found.richest_parameters
    loud = []
    for name, mask in masks(channel.drive, samples).items():
        inside = mask & use
        if name == "standstill" or inside.sum() < _FEWEST:
            continue
        gain, spread = gain_by_block(0.5 * (now - best)[inside], samples.block[inside])
        ratio = float(now[inside].sum() / max(best[inside].sum(), 1e-9))
        if gain > price and gain > _CLEAR_SIGMAS * spread and ratio > _LOUDER:
            loud.append((math.sqrt(ratio), name))
    return sorted(loud, reverse=True)[:_MOST_REGIMES]


def gain_by_block(gains: Array, block: Index) -> tuple[float, float]:
    """Sum of gains (n,) in nats and its standard deviation from blocks of time; infinite if there are too few."""
    sums = np.bincount(np.unique(block, return_inverse=True)[1], gains)
    if sums.size < _FEWEST_BLOCKS:
        return float(sums.sum()), math.inf
    around = sums - sums.mean()
    return float(sums.sum()), float(np.sqrt((around**2).sum() * sums.size / (sums.size - 1.0)))
