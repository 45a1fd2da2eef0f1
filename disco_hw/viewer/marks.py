"""Where in a log something happened that a person would want to look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from disco_hw.viewer.timeline import INNOVATION, LOOP, Timeline

FAULT, EVENT, OVERRUN, REJECTED_FRAMES, GATED = "fault", "event", "overrun", "rejected frames", "pose rejected"
ADAPTED = "adaptation"
KINDS = (FAULT, ADAPTED, EVENT, OVERRUN, REJECTED_FRAMES, GATED)
_TELLING = frozenset({"refused", "reverted", "lost"})
_APART_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened at `t_ns`: its kind, and what it was in words."""

    t_ns: int
    kind: str
    text: str


def marks_of(timeline: Timeline) -> tuple[Mark, ...]:
    """All marks in order of time; of one kind that comes again within half a second only the first."""
    marks = [
        *_faults(timeline),
        *(Mark(t_ns, EVENT, event.text) for t_ns, event in timeline.events),
        *_growth(*timeline.loop.rows(0, 1 << 62), LOOP.index("overruns"), OVERRUN),
        *_rejected_frames(timeline),
        *_gated(timeline),
        *(Mark(t_ns, ADAPTED, f"belief {change.source}: {change.reason}") for t_ns, change in timeline.beliefs),
        *_spaced([Mark(t_ns, ADAPTED, it.text) for t_ns, it in timeline.adaptations if it.outcome in _TELLING]),
    ]
    return tuple(sorted(marks, key=lambda mark: mark.t_ns))


def _faults(timeline: Timeline) -> list[Mark]:
    marks, before = [], "NONE"
    for t_ns, status in timeline.status:
        if status.fault not in {before, "NONE"}:
            marks.append(Mark(t_ns, FAULT, f"the robot reports {status.fault}"))
        before = status.fault
    return marks


def _growth(times: NDArray[np.int64], rows: NDArray[np.float64], column: int, kind: str) -> list[Mark]:
    grown = np.flatnonzero(np.diff(rows[:, column]) > 0.0) + 1
    return _spaced([Mark(int(times[i]), kind, f"{kind} number {int(rows[i, column])}") for i in grown])


def _rejected_frames(timeline: Timeline) -> list[Mark]:
    marks, before = [], None
    for t_ns, counters in timeline.counters:
        total = sum(count for name, count in counters.driver.items() if name.startswith("rejected"))
        total += counters.transport.get("malformed", 0)
        if before is not None and total > before:
            marks.append(Mark(t_ns, REJECTED_FRAMES, f"{total - before} frames rejected in the second before"))
        before = total
    return marks


def _gated(timeline: Timeline) -> list[Mark]:
    times, rows = timeline.innovation.rows(0, 1 << 62)
    refused = np.flatnonzero(rows[:, INNOVATION.index("accepted")] == 0.0)
    ratio = rows[:, INNOVATION.index("test_ratio")]
    texts = [
        f"a measured pose {ratio[i]:.1f} times the gate away" if np.isfinite(ratio[i]) else "a measured pose not used"
        for i in refused
    ]
    return _spaced([Mark(int(times[i]), GATED, text) for i, text in zip(refused, texts, strict=True)])


def _spaced(marks: list[Mark]) -> list[Mark]:
    kept: list[Mark] = []
    for mark in marks:
        if not kept or mark.t_ns - kept[-1].t_ns > _APART_NS:
            kept.append(mark)
    return kept
