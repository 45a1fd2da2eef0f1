"""Where simulation and data disagree: residuals by regime, and noise that is larger than it can be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.gridded_drive import GriddedDrive, GridSamples
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REST_RAD_S = 0.1
_SPEEDING_RAD_S2 = 2.0
_SPAN_NODES = 10
_FEWEST = 40
# Mean squares of whitened residuals are one; a regime says something from here on.
_EXCESS = 1.5


@dataclass(frozen=True, slots=True)
class Regime:
    """A part of the drive: mean square of the whitened residuals before and after, and how many samples."""

    name: str
    before: float
    after: float
    samples: int


def masks(drive: GriddedDrive, samples: GridSamples) -> Mapping[str, Mask]:
    """Which samples lie in which regime; regimes overlap."""
    return {name: mask[samples.node] for name, mask in masks_at_nodes(drive).items()}


def masks_at_nodes(drive: GriddedDrive) -> Mapping[str, Mask]:
    """Which nodes (M,) lie in which regime; regimes overlap."""
    speed = drive.speed_rad_s
    mean, half = speed.mean(axis=1), 0.5 * (speed[:, 1] - speed[:, 0])
    ahead = np.minimum(np.arange(speed.shape[0]) + _SPAN_NODES, speed.shape[0] - 1)
    behind = np.maximum(np.arange(speed.shape[0]) - _SPAN_NODES, 0)
    growth = (np.abs(speed[ahead]).max(axis=1) - np.abs(speed[behind]).max(axis=1)) / (2 * _SPAN_NODES * 0.01)
    size = np.abs(speed).max(axis=1)
    moving = size > _REST_RAD_S
    steady = moving & (np.abs(growth) < _SPEEDING_RAD_S2)
    middle = float(np.median(size[moving])) if moving.any() else 1.0
    turning = np.abs(half) > 0.3
    usual_turn = float(np.median(np.abs(half[turning]))) if turning.any() else 1.0
    times = np.linspace(drive.t_s[0], drive.t_s[-1], 4)
    return {
        "standstill": ~moving,
        "speeding up": moving & (growth >= _SPEEDING_RAD_S2),
        "braking": moving & (growth <= -_SPEEDING_RAD_S2),
        "slow": steady & (size <= middle),
        "fast": steady & (size > middle),
        "straight": steady & ~turning,
        "turning left": turning & (half > 0),
        "turning right": turning & (half < 0),
        "turning slowly": turning & (np.abs(half) <= usual_turn),
        "turning fast": turning & (np.abs(half) > usual_turn),
        "driving ahead": moving & (mean > 0.3),
        "driving back": moving & (mean < -0.3),
        "early": drive.t_s <= times[1],
        "late": drive.t_s >= times[2],
    }


def regimes(
    channel: WheelChannel | BodyChannel, before: Array, after: Array, extra: Array | None = None
) -> list[Regime]:
    """Every regime with enough samples, from the vectors before and after, the one that improves most first."""
    samples = channel.drive.encoder if isinstance(channel, WheelChannel) else channel.samples
    use = channel.gains.use if isinstance(channel, WheelChannel) else channel.use
    first = (channel.whitened(before) ** 2).mean(axis=1)
    last = (channel.whitened(after, extra) ** 2).mean(axis=1)
    found = []
    for name, mask in masks(channel.drive, samples).items():
        inside = mask & use
        if inside.sum() >= _FEWEST:
            found.append(Regime(name, float(first[inside].mean()), float(last[inside].mean()), int(inside.sum())))
    return sorted(found, key=lambda regime: -(regime.before - regime.after) * regime.samples**0.5)


def in_words(found: list[Regime]) -> str:
    """The regimes that disagree most, for a person."""
    loud = [regime for regime in found if regime.before > _EXCESS]
    if not loud:
        return "nowhere more than noise"
    worst = sorted(loud, key=lambda regime: -regime.before)[:3]
    return "most " + ", ".join(f"{r.name} ({r.before**0.5:.1f} times the noise)" for r in worst)
