"""Times of a bag's messages: stamps of the sender where there are any, on one clock that does not jump."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from disco_hw.log.drive import Index

_JUMP_NS = 500_000_000
_ONE_JUMP_NS = 3_000_000_000
_OTHER_CLOCK_NS = 1_000_000_000
_LEAD_NS = 50_000_000
_LARGEST_NS = 4 * 10**18


@dataclass(frozen=True, slots=True)
class Stamps:
    """Times of one topic's messages in order of their recording, all (N,), ns; a stamp of 0 is a missing one."""

    log_ns: Index
    stamp_ns: Index


@dataclass(frozen=True, slots=True)
class BagTimes:
    """Each topic's times (N,), ns, the times at which something broke off, and what a person should know."""

    t_ns: dict[str, Index]
    breaks_ns: Index
    notes: tuple[str, ...]


def timeline(stamps: Mapping[str, Stamps]) -> BagTimes:
    """Put all topics on the clock of the stamps.

    Where a clock was set (stamps go back by over 0.5 s, or ahead of the recording by that much) what follows is shifted
    back onto the clock of before, and a break marks the place. Times without a stamp are those of the recording,
    carried over to the clock of the stamps where the two are more than 1 s apart, as with a simulated clock.
    So are those of transforms that are dated ahead, to be valid for a while.
    """
    stamps = {name: Stamps(one.log_ns, _plausible(one.stamp_ns)) for name, one in stamps.items()}
    jumps = _jumps(stamps)
    shifted = {name: _without_jumps(one, jumps) for name, one in stamps.items()}
    notes = [
        f"the clock of the stamps was set {'back' if by_ns < 0 else 'ahead'} by {abs(by_ns) * 1e-9:.3g} s, "
        "which was taken out; a new segment begins there"
        for _, by_ns in jumps
    ]
    pairs = _pairs(shifted.values())
    usual_ns = float(np.median(pairs[:, 1] - pairs[:, 0])) if pairs.size else 0.0
    other_clock = abs(usual_ns) > _OTHER_CLOCK_NS
    if other_clock:
        apart_s = abs(usual_ns) * 1e-9
        notes.append(f"stamps and recording are {apart_s:.3g} s apart: a simulated clock, or one that was not set")
    times: dict[str, Index] = {}
    for name, one in shifted.items():
        missing = one.stamp_ns == 0
        lead_ns = float(np.median((one.stamp_ns - one.log_ns)[~missing])) - usual_ns if not missing.all() else 0.0
        if lead_ns > _LEAD_NS:
            notes.append(f"{name}: stamped {lead_ns * 1e-9:.2g} s ahead, as far as it is to hold; recording was taken")
            missing = np.ones_like(missing)
        elif missing.any():
            share = "no message" if missing.all() else f"{np.count_nonzero(missing)} of {missing.size} messages"
            has = "has a stamp" if missing.all() else "have no stamp"
            notes.append(f"{name}: {share} {has}; the time of recording was taken")
        recorded = _carried(one.log_ns, pairs) if other_clock else one.log_ns
        times[name] = np.where(missing, recorded, one.stamp_ns)
    breaks = np.array([at for at, _ in jumps], dtype=np.int64)
    return BagTimes(times, _carried(breaks, pairs) if other_clock else breaks, tuple(notes))


def _plausible(stamp_ns: Index) -> Index:
    return np.where((stamp_ns > 0) & (stamp_ns < _LARGEST_NS), stamp_ns, 0)


def _jumps(stamps: Mapping[str, Stamps]) -> list[tuple[int, int]]:
    """When (ns of the recording) the clock was set, and by how much (ns); topics agree on one jump."""
    found: list[tuple[int, int]] = []
    for one in stamps.values():
        found += [(int(one.log_ns[at]), by_ns) for at, by_ns in _own_jumps(one)]
    jumps: list[tuple[int, int]] = []
    cluster: list[tuple[int, int]] = []
    for jump in sorted(found):
        if cluster and jump[0] - cluster[0][0] > _ONE_JUMP_NS:
            jumps.append(_agreed(cluster))
            cluster = []
        cluster.append(jump)
    return [*jumps, _agreed(cluster)] if cluster else jumps


def _agreed(cluster: Sequence[tuple[int, int]]) -> tuple[int, int]:
    return min(at for at, _ in cluster), round(float(np.median([by_ns for _, by_ns in cluster])))


def _own_jumps(one: Stamps) -> list[tuple[int, int]]:
    """Places in a topic's messages at which its stamps jump, and by how much against the recording."""
    rows = np.flatnonzero(one.stamp_ns)
    log_ns, stamp_ns = one.log_ns[rows], one.stamp_ns[rows]
    steps = np.diff(stamp_ns)
    against = steps - np.diff(log_ns)
    age = log_ns - stamp_ns
    youngest = np.minimum.accumulate(age) if age.size else age
    # A burst after a stall has large steps too, but none of it is younger than what came before.
    ahead = (against > _JUMP_NS) & (age[1:] < youngest[:-1] - _JUMP_NS)
    found: list[tuple[int, int]] = []
    for at in np.flatnonzero((steps < -_JUMP_NS) | ahead):
        following = slice(at + 1, at + 6)
        stays = np.median(stamp_ns[following] - log_ns[following]) - (stamp_ns[at] - log_ns[at])
        # One late or early message is no jump of the clock.
        if abs(stays) > _JUMP_NS:
            found.append((int(rows[at + 1]), int(against[at])))
    return found


def _without_jumps(one: Stamps, jumps: Sequence[tuple[int, int]]) -> Stamps:
    stamp_ns = one.stamp_ns.copy()
    own = [at for at, _ in _own_jumps(one)]
    for log_ns, by_ns in jumps:
        near = [at for at in own if 0 <= one.log_ns[at] - log_ns <= _ONE_JUMP_NS]
        first = near[0] if near else int(np.searchsorted(one.log_ns, log_ns))
        stamp_ns[first:] = np.where(stamp_ns[first:] != 0, stamp_ns[first:] - by_ns, 0)
    return Stamps(one.log_ns, stamp_ns)


def _pairs(stamps: Iterable[Stamps]) -> Index:
    """Times of recording and stamps (N, 2), of the topic that has most of both, in order of recording."""
    both = [np.column_stack([one.log_ns, one.stamp_ns])[one.stamp_ns != 0] for one in stamps]
    return max(both, key=len, default=np.empty((0, 2), dtype=np.int64))


def _carried(log_ns: Index, pairs: Index) -> Index:
    """Times of recording on the clock of the stamps: interpolated between messages that have both, slope 1 beyond."""
    zero, first = int(pairs[0, 0]), int(pairs[0, 1])
    since, stamp = (pairs[:, 0] - zero).astype(np.float64), (pairs[:, 1] - first).astype(np.float64)
    at = (log_ns - zero).astype(np.float64)
    beyond = np.minimum(at - since[0], 0.0) + np.maximum(at - since[-1], 0.0)
    return np.asarray(np.rint(np.interp(at, since, stamp) + beyond).astype(np.int64) + first)
