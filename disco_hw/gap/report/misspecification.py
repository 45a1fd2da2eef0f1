"""Misspecification of accepted effects: residuals by regime, disagreements that are left, names of the wrong form.

An effect of the right family and the wrong form leaves a residue. The accepted set is compared with the richest model
of its channel, from which the noise was estimated. If that gains far more than its many parameters explain, in several
blocks of time, something is left.

A name is disputed if it explains little of what is missing, or if its value changes with the regime (parameter
constancy; Hansen, 1992).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.data.gridded_drive import GriddedDrive
from disco_hw.gap.noise import largest_command_jitter_s
from disco_hw.gap.noise.channels import BodyChannel, WheelChannel
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.search.least_squares import Fit, inverse
from disco_hw.gap.search.richest_model import CANDIDATES, DELAY_NAMES
from disco_hw.gap.settings import GRID_STEP_S, GapSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

_OPPOSITES = (
    ("slow", "fast"),
    ("turning slowly", "turning fast"),
    ("speeding up", "braking"),
    ("turning left", "turning right"),
    ("driving ahead", "driving back"),
)


def disputed_names(found: ChannelResult) -> dict[str, str]:
    """Return accepted effects that act like what is missing and cannot be it, each with the reason."""
    out = {}
    for name in found.names:
        if name in found.selector.given:
            continue
        why = _answers_otherwise(found, name) or _takes_little(found, name) or _changes_with_regime(found, name)
        if why is not None:
            out[name] = f"something acts like it and has another form: {why}"
    return out


def gain_of(found: ChannelResult, name: str) -> float:
    """Return the gain of a name in nats, with the others kept."""
    rest = tuple(other for other in found.names if other != name)
    return found.selector.exact(rest).cost - found.fit.cost


def _answers_otherwise(found: ChannelResult, name: str) -> str | None:
    """Describe why a delay or lag is disputed: the wheels respond otherwise than behind any that was tried."""
    if name in DELAY_NAMES and not found.channel.drive.commands_timed:
        return "wheels answer more slowly, or later, than behind any delay and lag that were tried before"
    return None


def _takes_little(found: ChannelResult, name: str) -> str | None:
    """Describe why a name is disputed that leaves much more than it explains, if its channel still disagrees."""
    settings = found.channel.settings.report
    if found.richest is None or not loud_regimes(found):
        return None
    best = 0.5 * float(found.richest @ found.richest)
    left = found.fit.cost - best - found.richest_parameters
    explained = max(gain_of(found, name), 0.0)
    if explained > settings.worth_share * (explained + left):
        return None
    return f"it takes {100.0 * explained / (explained + left):.2g} % of what its channel lacks"


def _changes_with_regime(found: ChannelResult, name: str) -> str | None:
    """Describe a value that changes with the regime by more than its noise and by much of itself; None if none does."""
    best, channel, settings = found.reported, found.selector.channel, found.channel.settings.report
    layout, drive = channel.layout, found.channel.drive
    columns = [column for column in CANDIDATES[name].columns if layout.place[column] in best.active]
    sizes = [abs(best.vector[layout.place[column]] - layout.neutral[layout.place[column]]) for column in columns]
    size = max((each for each in sizes if math.isfinite(each)), default=math.inf)
    samples = found.channel.samples
    width = best.residual.size // samples.node.size
    inside = {regime: np.repeat(mask[samples.node], width) for regime, mask in masks(drive).items()}
    clearest: tuple[float, str] = (settings.form_apart_sigmas, "")
    for column, (one, other) in product(columns, _OPPOSITES):
        place, value = best.active.index(layout.place[column]), float(best.vector[layout.place[column]])
        apart = _apart(best, channel.block, place, (inside[one], inside[other]), channel.settings)
        if apart is None:
            continue
        moved, moved_too, sigmas = apart
        if abs(moved - moved_too) > settings.wide_share * (abs(value) if math.isinf(size) else size):
            text = f"{column} is {value + moved:.3g} {one} and {value + moved_too:.3g} {other}"
            clearest = max(clearest, (abs(sigmas), text))
    return clearest[1] or None


def _apart(
    best: Fit, block: Index, place: int, inside: tuple[Mask, Mask], settings: GapSettings
) -> tuple[float, float, float] | None:
    """Change of an active entry in each of two regimes, all fitted with it, and their difference in sigmas; or None."""
    slope = best.jacobian[:, place]
    column = float(slope @ slope)
    parts = np.column_stack([np.where(mask, slope, 0.0) for mask in inside])
    if min((parts**2).sum(axis=0)) < settings.fit.part_known_share / len(inside) * column:
        return None
    wide = np.column_stack([best.jacobian, parts])
    covariance = inverse(wide.T @ wide)
    step = -covariance @ (wide.T @ best.residual)
    # Neighbouring blocks err together: a few are taken as one, and the larger of two variances counts.
    group = np.unique(block // settings.selection.block_lengths[1], return_inverse=True)[1]
    pulls = np.zeros((group.max() + 1, wide.shape[1]))
    np.add.at(pulls, group, wide * (best.residual + wide @ step)[:, None])
    contrast = covariance[-2] - covariance[-1]
    variance = max(float(contrast[-2] - contrast[-1]), float(((pulls @ contrast) ** 2).sum()))
    both = step[place] + step[-2:]
    return float(both[0]), float(both[1]), float((both[0] - both[1]) / math.sqrt(variance))


@dataclass(frozen=True, slots=True)
class Regime:
    """A part of the drive: mean square of the whitened residuals before and after, and how many samples."""

    name: str
    before: float
    after: float
    samples: int


def masks(drive: GriddedDrive) -> Mapping[str, Mask]:
    """Which nodes (M,) lie in which regime; regimes overlap."""
    speed, settings = drive.speed_rad_s, drive.settings.report
    span = drive.settings.terms.smooth_nodes
    mean, half = speed.mean(axis=1), 0.5 * (speed[:, 1] - speed[:, 0])
    ahead = np.minimum(np.arange(speed.shape[0]) + span, speed.shape[0] - 1)
    behind = np.maximum(np.arange(speed.shape[0]) - span, 0)
    growth = (np.abs(speed[ahead]).max(axis=1) - np.abs(speed[behind]).max(axis=1)) / (2 * span * GRID_STEP_S)
    size = np.abs(speed).max(axis=1)
    moving = size > drive.settings.grid.rest_rad_s
    steady = moving & (np.abs(growth) < settings.speeding_rad_s2)
    turning = np.abs(half) > 0.3
    slow, fast = _halves(size, moving, settings.worth_share)
    turning_slowly, turning_fast = _halves(np.abs(half), turning, settings.worth_share)
    times = np.linspace(drive.t_s[0], drive.t_s[-1], 4)
    return {
        "standstill": ~moving,
        "speeding up": moving & (growth >= settings.speeding_rad_s2),
        "braking": moving & (growth <= -settings.speeding_rad_s2),
        "slow": steady & slow,
        "fast": steady & fast,
        "straight": steady & ~turning,
        "turning left": turning & (half > 0),
        "turning right": turning & (half < 0),
        "turning slowly": turning_slowly,
        "turning fast": turning_fast,
        "driving ahead": moving & (mean > 0.3),
        "driving back": moving & (mean < -0.3),
        "early": drive.t_s <= times[1],
        "late": drive.t_s >= times[2],
    }


def _halves(size: Array, of: Mask, apart: float) -> tuple[Mask, Mask]:
    """Nodes (M,) of a part of the drive with a size below its median there and above it, by the share `apart` or more.

    Between nodes nearer to it noise alone decides, and every value that goes with the size would differ.
    """
    middle = float(np.median(size[of])) if of.any() else 0.0
    return of & (size <= (1.0 - apart) * middle), of & (size > (1.0 + apart) * middle)


def regimes(
    channel: WheelChannel | BodyChannel, before: Array, after: Array, extra: Array | None = None
) -> list[Regime]:
    """Every regime with enough samples, from the vectors before and after, the one that improves most first."""
    samples, use = channel.samples, channel.use
    first = (channel.whitened(before) ** 2).mean(axis=1)
    last = (channel.whitened(after, extra) ** 2).mean(axis=1)
    found = []
    for name, mask in masks(channel.drive).items():
        inside = mask[samples.node] & use
        if inside.sum() >= channel.settings.grid.fewest_samples:
            found.append(Regime(name, float(first[inside].mean()), float(last[inside].mean()), int(inside.sum())))
    return sorted(found, key=lambda regime: -(regime.before - regime.after) * regime.samples**0.5)


def describe(found: list[Regime], excess: float) -> str:
    """Describe the regimes that disagree most, with more than `excess` times the mean square of noise."""
    loud = [regime for regime in found if regime.before > excess]
    if not loud:
        return "nowhere more than noise"
    worst = sorted(loud, key=lambda regime: -regime.before)[:3]
    return "most " + ", ".join(f"{r.name} ({r.before**0.5:.1f} times the noise)" for r in worst)


def remaining_disagreements(found: ChannelResult) -> list[str]:
    """Sentences on what a channel's accepted set leaves, the loudest regime first; none where nothing is left."""
    channel = found.channel
    name = "command_to_wheel" if isinstance(channel, WheelChannel) else "wheel_to_body"
    out = [f"{name}: {regime} still disagrees: {times:.1f} times the noise" for times, regime in loud_regimes(found)]
    if isinstance(channel, WheelChannel):
        drive = channel.drive
        largest_s = largest_command_jitter_s(drive)
        if channel.noise.command_stamp_s > (1.0 - channel.settings.report.end_share) * largest_s:
            out.append(
                f"{name}: speeding up and braking still disagree: as if commands came "
                f"{1e3 * channel.noise.command_stamp_s:.0f} ms early or late at random, the encoder's time stamps "
                f"scatter by {1e3 * drive.stamp_scatter_s:.1f} ms"
            )
    return out


def loud_regimes(found: ChannelResult) -> list[tuple[float, str]]:
    """Root mean square of what is left over the noise's, and name, of regimes in which something is left."""
    channel, settings = found.channel, found.channel.settings.report
    if found.richest is None:
        return []
    samples, use = channel.samples, channel.use
    width = found.richest.size // use.size
    now = (found.fit.residual.reshape(-1, width) ** 2).sum(axis=1)
    best = (found.richest.reshape(-1, width) ** 2).sum(axis=1)
    # One nat for each parameter is the price of Akaike's criterion.
    price = channel.settings.selection.unnamed_score + found.richest_parameters
    loud, chosen = [], channel.settings.selection
    for name, mask in masks(channel.drive).items():
        inside = mask[samples.node] & use
        if name == "standstill" or inside.sum() < channel.settings.grid.fewest_samples:
            continue
        gain, spread = gain_by_block(0.5 * (now - best)[inside], samples.block[inside], chosen.fewest_blocks)
        ratio = float(now[inside].sum() / max(best[inside].sum(), 1e-9))
        if gain > price and gain > chosen.sure_sigmas * spread and ratio > 1.0 + settings.worth_share:
            loud.append((math.sqrt(ratio), name))
    return sorted(loud, reverse=True)[: settings.most_listed]


def gain_by_block(gains: Array, block: Index, fewest: int) -> tuple[float, float]:
    """Sum of gains (n,) in nats and its standard deviation from blocks of time; infinite if there are too few."""
    sums = np.bincount(np.unique(block, return_inverse=True)[1], gains)
    if sums.size < fewest:
        return float(sums.sum()), math.inf
    around = sums - sums.mean()
    return float(sums.sum()), float(np.sqrt((around**2).sum() * sums.size / (sums.size - 1.0)))
