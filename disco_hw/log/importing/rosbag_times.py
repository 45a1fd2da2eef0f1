"""When the messages of a bag were true: the stamps of each topic, mended where a clock was set or a stamp stands still.

Each topic is judged by itself: a publisher whose stamps are wrong spoils no other topic. Only what most topics show at
one time, that the robot's clock was set, concerns all of them.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.log.drive import Array, Index
from disco_hw.log.importing.losses import WARNING

Mask = NDArray[np.bool_]

# Chosen: smaller steps are late messages; larger ones, that last, are a clock that was set.
_JUMP_NS = 500_000_000
# Chosen: topics show one jump within this time, by when their next messages come.
_ONE_JUMP_NS = 3_000_000_000
# Chosen: a usual difference above it is more than any delay.
_OTHER_CLOCK_NS = 1_000_000_000
# Chosen: a topic that is stamped further ahead is stamped with when it ends to be valid.
_LEAD_NS = 50_000_000
# Year 2096: later stamps are damage, and sums of two still fit into 64 bits.
_LARGEST_NS = 4 * 10**18
_SAME_CLOCK_NS = 30_000_000_000
"""Stamps of one clock may come so much apart, as where messages wait; those of another clock are further off."""
_CONSTANT_NS, _REPEATS_NS = 20_000_000, 300_000_000
"""Messages recorded further apart than this were not true at one time: those that differ, and those that are alike, as
where the last measurement is sent again."""
_STANDING_SHARE = 0.02
"""A topic of which more of the stamps stand still is dated by the recording."""


@dataclass(frozen=True, slots=True)
class Stamps:
    """Times of one topic's messages in order of their recording, all (N,), ns; a stamp of 0 is a missing one.

    `is_repeat`: which messages hold the values of the one before.
    """

    log_ns: Index
    stamp_ns: Index
    is_repeat: Mask | None = None


@dataclass(slots=True)
class Column:
    """Samples collected from one topic, or from one edge of the transforms."""

    width: int
    log_ns: array[int] = field(default_factory=lambda: array("q"))
    stamp_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))
    left_out: int = 0

    def add(self, log_ns: int, stamp_ns: int, row: tuple[float, ...] | None) -> None:
        """Keep a row, or count that there was none."""
        if row is None:
            self.left_out += 1
            return
        self.log_ns.append(log_ns)
        self.stamp_ns.append(stamp_ns)
        self.values.extend(row)

    def stamps(self) -> Stamps:
        """Return the times of its rows."""
        table = self.table()
        is_repeat = np.concatenate([[False], alike(table[1:], table[:-1])]) if len(table) else np.empty(0, dtype=bool)
        return Stamps(np.array(self.log_ns, dtype=np.int64), np.array(self.stamp_ns, dtype=np.int64), is_repeat)

    def table(self) -> Array:
        """Return the column's rows, (N, width)."""
        return np.array(self.values, dtype=np.float64).reshape(-1, self.width)


def alike(one: Array, other: Array) -> NDArray[np.bool_]:
    """Whether the rows of two tables (N, k) hold the same values."""
    return np.asarray(((one == other) | (np.isnan(one) & np.isnan(other))).all(axis=1))


@dataclass(frozen=True, slots=True)
class BagTimes:
    """Times of each topic (N,), ns, the times at which something broke off, and messages for the operator."""

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
    stamps = {name: replace(one, stamp_ns=_plausible(one.stamp_ns)) for name, one in stamps.items()}
    faults = {name: fault for name, one in stamps.items() if (fault := _standing(one))}
    stamps = _without_stamps(stamps, faults)
    foreign = _of_another_clock(stamps)
    stamps = _without_stamps(stamps, foreign)
    jumps, alone = _jumps(stamps)
    stamps = _without_stamps(stamps, alone)
    faults |= dict.fromkeys(foreign, "are of another clock than those of other topics")
    faults |= dict.fromkeys(alone, "jump where those of other topics do not")
    notes = [
        f"{WARNING}{name}: its stamps {faults[name]}; the time of recording was taken for this topic"
        for name in sorted(faults)
    ]
    shifted = {name: _without_jumps(one, jumps) for name, one in stamps.items()}
    notes += [
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
        elif missing.any() and name not in faults:
            share = "no message" if missing.all() else f"{np.count_nonzero(missing)} of {missing.size} messages"
            has = "has a stamp" if missing.all() else "have no stamp"
            notes.append(f"{name}: {share} {has}; the time of recording was taken")
        recorded = _carried(one.log_ns, pairs) if other_clock else one.log_ns
        times[name] = np.where(missing, recorded, one.stamp_ns)
    breaks = np.array([at for at, _ in jumps], dtype=np.int64)
    return BagTimes(times, _carried(breaks, pairs) if other_clock else breaks, tuple(notes))


def _plausible(stamp_ns: Index) -> Index:
    return np.where((stamp_ns > 0) & (stamp_ns < _LARGEST_NS), stamp_ns, 0)


_Jump = tuple[int, int, str]
"""When (ns of the recording) the stamps of a topic jump, by how much (ns), and the topic's name."""


def _jumps(stamps: Mapping[str, Stamps]) -> tuple[list[tuple[int, int]], set[str]]:
    """Return when (ns of the recording) the clock was set, and by how much (ns); and topics that jump by themselves.

    A clock that is set shows in most of the topics that have stamps before and after.
    """
    found = sorted(
        (int(one.log_ns[at]), by_ns, name) for name, one in stamps.items() for at, by_ns in _clock_jumps(one)
    )
    clusters: list[list[_Jump]] = []
    for jump in found:
        if clusters and jump[0] - clusters[-1][0][0] <= _ONE_JUMP_NS:
            clusters[-1].append(jump)
        else:
            clusters.append([jump])
    jumps: list[tuple[int, int]] = []
    alone: set[str] = set()
    for cluster in clusters:
        names = {name for _, _, name in cluster}
        if 2 * len(names) >= len(_dated_about(stamps, cluster[0][0])):
            jumps.append((cluster[0][0], round(float(np.median([by_ns for _, by_ns, _ in cluster])))))
        else:
            alone |= names
    return jumps, alone


def _dated_about(stamps: Mapping[str, Stamps], log_ns: int) -> set[str]:
    """Names of the topics that have stamps both before and after a time of the recording."""
    found = set()
    for name, one in stamps.items():
        recorded = one.log_ns[one.stamp_ns != 0]
        if recorded.size and recorded[0] < log_ns <= recorded[-1]:
            found.add(name)
    return found


def _standing(one: Stamps) -> str:
    """Describe a topic's stamps that stand still while the recording goes on, with their share; else empty."""
    if one.stamp_ns.size < 2:
        return ""
    changes = np.concatenate([[True], (np.diff(one.stamp_ns) != 0) | (one.stamp_ns[1:] == 0)])
    began_ns = one.log_ns[np.maximum.accumulate(np.where(changes, np.arange(changes.size), 0))]
    is_repeat = np.zeros(changes.size, dtype=bool) if one.is_repeat is None else one.is_repeat
    same = one.log_ns - began_ns > np.where(is_repeat, _REPEATS_NS, _CONSTANT_NS)
    share = np.count_nonzero(same) / one.stamp_ns.size
    return f"stand still while the recording goes on ({100.0 * share:.0f} %)" if share > _STANDING_SHARE else ""


def _of_another_clock(stamps: Mapping[str, Stamps]) -> set[str]:
    """Names of the topics whose stamps are apart from the recording by another time than those of most topics."""
    apart_ns = {
        name: float(np.median((one.stamp_ns - one.log_ns)[one.stamp_ns != 0]))
        for name, one in stamps.items()
        if one.stamp_ns.any()
    }
    if len(apart_ns) < 2:
        return set()

    def near(value: float) -> set[str]:
        return {name for name, other in apart_ns.items() if abs(other - value) <= _SAME_CLOCK_NS}

    # Of two clocks that as many topics show the one nearer to the recording's is believed.
    usual = max(apart_ns.values(), key=lambda value: (len(near(value)), -abs(value)))
    return set(apart_ns) - near(usual)


def _without_stamps(stamps: Mapping[str, Stamps], names: Iterable[str]) -> dict[str, Stamps]:
    """Return the stamps, with none (0) for the topics that are named."""
    without = set(names)
    return {
        name: Stamps(one.log_ns, np.zeros_like(one.stamp_ns)) if name in without else one
        for name, one in stamps.items()
    }


def _clock_jumps(one: Stamps) -> list[tuple[int, int]]:
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
    places = [at for at, _ in _clock_jumps(one)]
    for log_ns, by_ns in jumps:
        near = [at for at in places if 0 <= one.log_ns[at] - log_ns <= _ONE_JUMP_NS]
        first = near[0] if near else int(np.searchsorted(one.log_ns, log_ns))
        stamp_ns[first:] = np.where(stamp_ns[first:] != 0, stamp_ns[first:] - by_ns, 0)
    return Stamps(one.log_ns, stamp_ns)


def _pairs(stamps: Iterable[Stamps]) -> Index:
    """Return times of recording and stamps (N, 2), of the topic that has most of both, in order of recording."""
    both = [np.column_stack([one.log_ns, one.stamp_ns])[one.stamp_ns != 0] for one in stamps]
    return max(both, key=len, default=np.empty((0, 2), dtype=np.int64))


def _carried(log_ns: Index, pairs: Index) -> Index:
    """Return times of recording on the stamps' clock: interpolated between messages that have both, slope 1 beyond."""
    zero, first = int(pairs[0, 0]), int(pairs[0, 1])
    since, stamp = (pairs[:, 0] - zero).astype(np.float64), (pairs[:, 1] - first).astype(np.float64)
    at = (log_ns - zero).astype(np.float64)
    beyond = np.minimum(at - since[0], 0.0) + np.maximum(at - since[-1], 0.0)
    return np.asarray(np.rint(np.interp(at, since, stamp) + beyond).astype(np.int64) + first)
