"""Whether a named effect of the body has the form that its name says: as strong where little of it acts as where much.

A slip that saturates passes for one that grows for ever, weaker than it is at first and stronger than it is later.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.data.layout import BODY
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.search.candidates import CANDIDATES, indices
from disco_hw.gap.search.channel_search import ChannelResult
from disco_hw.gap.search.evidence import inflation
from disco_hw.gap.search.least_squares import fit
from disco_hw.gap.search.selection import Split
from disco_hw.gap.search.unnamed_terms import Term, WithTerms
from disco_hw.gap.settings import GRID_STEP_S

Array = NDArray[np.float64]

_UNITS = ("m/s ahead", "m/s to the side", "rad/s")


def misspecified_effects(found: ChannelResult) -> list[str]:
    """Sentences on accepted effects of the body that are not as strong where they are small as where they are large."""
    channel = found.channel
    if not isinstance(channel, BodyChannel):
        return []
    out, settings = [], channel.settings.report
    for name in found.names:
        perturbation = _perturbation_of(found.selector.split(found.names), name, channel)
        level, axis = _middle(perturbation, settings.lever_m)
        if level <= 0.0:
            continue
        # What saturates grows with less than its first power, what sets in late with more.
        more = perturbation * np.sqrt(np.abs(perturbation[:, axis]) / level)[:, None]
        wide = WithTerms.of(channel, (*(one.term for one in found.unnamed), Term("", more)))
        now = found.fit
        free = fit(wide, np.append(now.vector, 0.0), indices(wide, found.names))
        if 2.0 * (now.cost - free.cost) < settings.form_sigmas**2 * inflation(free, wide, (free.vector.size - 1,)):
            continue
        again = _perturbation_of(wide.split(free.vector), name, channel)
        share = float((again * perturbation).sum() / (perturbation**2).sum())
        times = _ratio(share + 0.5 * float(free.vector[-1]), share + float(free.vector[-1]), settings.largest_ratio)
        out.append(
            f"wheel_to_body: {name} is {times:.1f} times as strong where it makes up {0.25 * level:.2g} "
            f"{_UNITS[axis]} as where it makes up {level:.2g}: 95 % sure that its form is another"
        )
    return out


def _ratio(small: float, large: float, most: float) -> float:
    """How much stronger where small, within what can be said."""
    if large <= small / most:
        return most
    return max(small / large, 1.0 / most)


def _perturbation_of(split: Split, name: str, channel: BodyChannel) -> Array:
    """What an effect adds to the body's velocity at the nodes of a fit, (M, 3) in m/s, m/s, rad/s."""
    place = channel.layout.place
    vector, extra = split
    without = vector.copy()
    columns = [place[column] for column in CANDIDATES[name].columns]
    without[columns] = channel.layout.neutral[columns]
    if not REGISTRY[name].moves:
        return np.zeros((channel.drive.t_s.size, 3))
    return _velocity(channel, vector, extra) - _velocity(channel, without, extra)


def _velocity(channel: BodyChannel, vector: Array, extra: Array | None) -> Array:
    """Velocity of the point of the axle that rolls, in the body's frame, at the nodes of a free run, (M, 3); zero where
    a run ends.
    """
    track = channel.track(vector, extra)
    step = np.diff(track, axis=0, append=track[-1:])
    step[np.append(channel.drive.first[1:], True)] = 0.0
    yaw = track[:, 2] + 0.5 * step[:, 2]
    ahead = np.cos(yaw) * step[:, 0] + np.sin(yaw) * step[:, 1]
    # Of the point that rolls, as a perturbation of the yaw rate moves the tracked one to the side by itself.
    left = np.cos(yaw) * step[:, 1] - np.sin(yaw) * step[:, 0] + BODY.at(vector, "x_icr_m") * step[:, 2]
    return np.column_stack([ahead, left, step[:, 2]]) / GRID_STEP_S


def _middle(perturbation: Array, lever_m: float) -> tuple[float, int]:
    """The size below which half of what an effect does is done, and the axis it acts on most."""
    power = (perturbation * (1.0, 1.0, lever_m)) ** 2
    axis = int(np.argmax(power.sum(axis=0)))
    size = np.sort(np.abs(perturbation[:, axis]))
    share = np.cumsum(size**2)
    if share[-1] <= 0.0:
        return 0.0, axis
    return float(size[np.searchsorted(share, 0.5 * share[-1])]), axis
