"""Whether a named effect of the body has the form that its name says: as strong where little of it acts as where much.

A slip that saturates passes for one that grows for ever, weaker than it is at first and stronger than it is later.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.candidates import CANDIDATES, indices
from disco_hw.gap.channels import BodyChannel
from disco_hw.gap.evidence import compare
from disco_hw.gap.fit import fit
from disco_hw.gap.search import Found
from disco_hw.gap.terms import Term, WithTerms
from disco_hw.gap.timeline import CELL_S
from disco_hw.model.effects import REGISTRY

Array = NDArray[np.float64]

_SIGMAS = 3.0
_LEVER_M = 0.2
_UNITS = ("m/s ahead", "m/s to the side", "rad/s")


def other_forms(found: Found) -> list[str]:
    """Sentences on accepted effects of the body that are not as strong where they are small as where they are large."""
    channel = found.channel
    if not isinstance(channel, BodyChannel):
        return []
    out = []
    for name in found.names:
        pushed = _pushed(found, name, channel)
        level, axis = _middle(pushed)
        if level <= 0.0:
            continue
        small = np.where((np.abs(pushed[:, axis]) < level)[:, None], pushed, 0.0)
        wide = WithTerms.of(channel, (*(one.term for one in found.unnamed), Term("", small)))
        now = found.fit
        free = fit(wide, np.append(now.vector, 0.0), indices(wide, found.names))
        proof = compare(now, free, channel, 1.0)
        if 2.0 * proof.gain > _SIGMAS**2 * proof.inflation and proof.repeated > 0.0:
            out.append(
                f"wheel_to_body: {name} is {1.0 + free.vector[-1]:.1f} times as strong where it makes up less than "
                f"{level:.2g} {_UNITS[axis]} as where it makes up more: its form is another"
            )
    return out


def _pushed(found: Found, name: str, channel: BodyChannel) -> Array:
    """What an accepted effect adds to the body's velocity at the nodes, (M, 3) in m/s, m/s, rad/s."""
    place = channel.layout.place
    vector, extra = found.selector.split(found.names)
    without = vector.copy()
    columns = [place[column] for column in CANDIDATES[name].columns]
    without[columns] = channel.layout.neutral[columns]
    if not REGISTRY[name].moves:
        return np.zeros((channel.timeline.t_s.size, 3))
    return _velocity(channel, vector, extra) - _velocity(channel, without, extra)


def _velocity(channel: BodyChannel, vector: Array, extra: Array | None) -> Array:
    """Velocity in the body's frame at the nodes of a free run, (M, 3); zero where a run ends."""
    track = channel.track(vector, extra)
    step = np.diff(track, axis=0, append=track[-1:])
    step[np.append(channel.timeline.first[1:], True)] = 0.0
    yaw = track[:, 2] + 0.5 * step[:, 2]
    ahead = np.cos(yaw) * step[:, 0] + np.sin(yaw) * step[:, 1]
    left = np.cos(yaw) * step[:, 1] - np.sin(yaw) * step[:, 0]
    return np.column_stack([ahead, left, step[:, 2]]) / CELL_S


def _middle(pushed: Array) -> tuple[float, int]:
    """The size below which half of what an effect does is done, and the axis it acts on most."""
    power = (pushed * (1.0, 1.0, _LEVER_M)) ** 2
    axis = int(np.argmax(power.sum(axis=0)))
    size = np.sort(np.abs(pushed[:, axis]))
    share = np.cumsum(size**2)
    if share[-1] <= 0.0:
        return 0.0, axis
    return float(size[np.searchsorted(share, 0.5 * share[-1])]), axis
