"""Timeline of a run up to now, in columns that can be cut at any time; live page and replay fill the same one."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from disco_hw.drive.coverage import Coverage
from disco_hw.log import records
from disco_hw.runtime.pipeline import Source
from drivers.types import PoseSample, PowerSample, RobotLinkHealth, RobotStatus, WheelSample

Array = NDArray[np.float64]
Times = NDArray[np.int64]
Item = TypeVar("Item")
# Chosen: room to begin with, which grows twofold.
_FIRST_ROWS = 256


class Series:
    """Rows of numbers with the tick in which each became known (ns), in that order."""

    def __init__(self, columns: tuple[str, ...]) -> None:
        self.columns = columns
        self._times = np.empty(_FIRST_ROWS, np.int64)
        self._rows = np.empty((_FIRST_ROWS, len(columns)))
        self._count = 0
        self._new_times: list[int] = []
        self._new_rows: list[tuple[float, ...]] = []

    def __len__(self) -> int:
        return self._count + len(self._new_times)

    def append(self, now_ns: int, row: tuple[float, ...]) -> None:
        """Add a row of as many numbers as there are columns."""
        self._new_times.append(now_ns)
        self._new_rows.append(row)

    def _merge(self) -> None:
        """Put what was added into the arrays, all at once: one row costs as much as a hundred together."""
        count = self._count + len(self._new_times)
        if count == self._count:
            return
        if count > len(self._times):
            room = max(count, 2 * len(self._times)) - len(self._times)
            self._times = np.concatenate((self._times, np.empty(room, np.int64)))
            self._rows = np.concatenate((self._rows, np.empty((room, len(self.columns)))))
        self._times[self._count : count] = self._new_times
        self._rows[self._count : count] = self._new_rows
        self._count, self._new_times, self._new_rows = count, [], []

    def rows(self, first_ns: int, last_ns: int) -> tuple[Times, Array]:
        """Return times (N,) and rows (N, columns) with first_ns <= time <= last_ns; views, not copies."""
        self._merge()
        times = self._times[: self._count]
        first, last = np.searchsorted(times, first_ns, "left"), np.searchsorted(times, last_ns, "right")
        return times[first:last], self._rows[first:last]

    def last(self, at_ns: int) -> tuple[int, Array] | None:
        """Return the newest row known at `at_ns` and its time; None before the first."""
        self._merge()
        index = int(np.searchsorted(self._times[: self._count], at_ns, "right")) - 1
        return None if index < 0 else (int(self._times[index]), self._rows[index])

    def drop_before(self, oldest_ns: int) -> None:
        """Drop rows from before `oldest_ns`, once they are at least half of all."""
        self._merge()
        first = int(np.searchsorted(self._times[: self._count], oldest_ns, "left"))
        if 2 * first >= self._count > 0:
            self._times = self._times[first : max(self._count, first + _FIRST_ROWS)].copy()
            self._rows = self._rows[first : max(self._count, first + _FIRST_ROWS)].copy()
            self._count -= first


class Items(Generic[Item]):
    """Records that are not rows of numbers, with the tick in which each became known."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._items: list[Item] = []

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[tuple[int, Item]]:
        return iter(zip(self._times, self._items, strict=True))

    def append(self, now_ns: int, item: Item) -> None:
        """Append one record of the log or feed to the timeline."""
        self._times.append(now_ns)
        self._items.append(item)

    def last(self, at_ns: int) -> Item | None:
        """Return the newest one known at `at_ns`; None before the first."""
        index = bisect_right(self._times, at_ns) - 1
        return None if index < 0 else self._items[index]

    def latest(self, at_ns: int, count: int) -> list[tuple[int, Item]]:
        """Return the last `count` known at `at_ns`, oldest first."""
        end = bisect_right(self._times, at_ns)
        first = max(0, end - count)
        return list(zip(self._times[first:end], self._items[first:end], strict=True))

    def drop_before(self, oldest_ns: int) -> None:
        """Drop those from before `oldest_ns`, but never the newest."""
        first = min(bisect_right(self._times, oldest_ns), max(len(self._times) - 1, 0))
        del self._times[:first], self._items[:first]

    def clear(self) -> None:
        """Remove all records."""
        self._times.clear()
        self._items.clear()


# Columns are named as the fields of the records that they come from.
ESTIMATE = ("x_m", "y_m", "yaw_rad", "speed_m_s", "yaw_rate_rad_s", "pose_healthy")
COVARIANCE = tuple(f"cov{row}{column}" for row in range(3) for column in range(3))
WHEELS = ("left_angle_rad", "right_angle_rad", "left_speed_rad_s", "right_speed_rad_s")
COMMAND = ("left_rad_s", "right_rad_s", "in_force")
POSE = ("x_m", "y_m", "yaw_rad")
INNOVATION = ("x_m", "y_m", "yaw_rad", "variance_x", "variance_y", "variance_yaw", "test_ratio", "accepted")
PLANNER = ("effective_samples", "temperature")
LOOP = ("lateness_ns", "overruns", "skipped")
POWER = ("voltage_v", "current_a", "temperature_c")


class Timeline:
    """Timeline with every series of a run, and whole plans where it is given them; a replay reads these itself."""

    def __init__(self) -> None:
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.estimate = Series((*ESTIMATE, *COVARIANCE))
        self.wheels = Series(WHEELS)
        self.command = Series(COMMAND)
        self.pose = Series(POSE)
        self.innovation = Series(INNOVATION)
        self.planner = Series(PLANNER)
        self.loop = Series(LOOP)
        self.power = Series(POWER)
        self.plans: Items[records.Plan] = Items()
        self.status: Items[RobotStatus] = Items()
        self.link: Items[RobotLinkHealth] = Items()
        self.state: Items[records.DaemonState] = Items()
        self.source: Items[str] = Items()
        self.events: Items[records.Event] = Items()
        self.counters: Items[records.Counters] = Items()
        self.fans: Items[records.Fan] = Items()
        self.tasks: Items[records.Task] = Items()
        self.beliefs: Items[records.BeliefChange] = Items()
        self.adaptations: Items[records.Adaptation] = Items()
        self.guards: Items[records.GuardVerdict] = Items()
        self.fences: Items[records.FenceChange] = Items()
        estimate_of, planner_of = attrgetter(*ESTIMATE), attrgetter(*PLANNER)
        self._rows: dict[type, tuple[Series, Callable[[Any], tuple[float, ...]]]] = {
            records.Estimate: (self.estimate, lambda it: (*estimate_of(it), *it.covariance)),
            WheelSample: (self.wheels, attrgetter(*WHEELS)),
            records.Command: (self.command, attrgetter(*COMMAND)),
            PoseSample: (self.pose, attrgetter(*POSE)),
            records.Innovation: (
                self.innovation,
                # A pose of which there are more than needed is no rejected one.
                lambda it: (*it.innovation, *it.variance, it.test_ratio, it.accepted or it.reason == "overflow"),
            ),
            records.Plan: (self.planner, planner_of),
            records.PlanFigures: (self.planner, planner_of),
            records.LoopTiming: (self.loop, attrgetter(*LOOP)),
            PowerSample: (self.power, attrgetter(*POWER)),
        }
        self._as_they_are: dict[type, Items[Any]] = {
            RobotStatus: self.status, RobotLinkHealth: self.link, records.DaemonState: self.state,
            records.Event: self.events, records.Counters: self.counters, records.Fan: self.fans,
            records.Task: self.tasks, records.BeliefChange: self.beliefs, records.Adaptation: self.adaptations,
            records.FenceChange: self.fences,
        }  # fmt: skip

    def add(self, now_ns: int, record: records.Record | records.PlanFigures) -> None:
        """Take in one record of the tick at `now_ns`; ticks come in order. Frames are not kept."""
        self.first_ns = now_ns if self.first_ns is None else self.first_ns
        self.last_ns = now_ns
        if type(record) in self._rows:
            series, row_of = self._rows[type(record)]
            series.append(now_ns, row_of(record))
        match record:
            case records.Command() as it:
                if self.source.last(now_ns) != it.source:
                    self.source.append(now_ns, it.source)
            case records.Plan() as it:
                self.plans.append(now_ns, it)
            case records.GuardVerdict() as it:
                # Those between two that hold a path would hide it.
                if it.path_x_m or it.obstacles or it.reason:
                    self.guards.append(now_ns, it)
            case _ if type(record) in self._as_they_are:
                self._as_they_are[type(record)].append(now_ns, record)

    def drop_before(self, oldest_ns: int) -> None:
        """Drop what is older, so that a page that stays open does not grow."""
        for series, _ in self._rows.values():
            series.drop_before(oldest_ns)
        others: tuple[Items[Any], ...] = (self.plans, self.source, self.guards)
        for items in (*others, *self._as_they_are.values()):
            items.drop_before(oldest_ns)


FAULT, EVENT, OVERRUN, REJECTED_FRAMES, GATED = "fault", "event", "overrun", "rejected frames", "pose rejected"
ADAPTED = "adaptation"
KINDS = (FAULT, ADAPTED, EVENT, OVERRUN, REJECTED_FRAMES, GATED)
_INFORMATIVE = frozenset({"refused", "reverted", "lost", "taken_over"})
# Chosen: marks that are nearer are of one cause.
_APART_NS = 500_000_000


@dataclass(frozen=True, slots=True)
class Mark:
    """Mark of something that happened at `t_ns`: its kind, and what it was in words."""

    t_ns: int
    kind: str
    text: str


def marks_of(timeline: Timeline) -> tuple[Mark, ...]:
    """Return all marks in order of time; of one kind that comes again within half a second only the first."""
    marks = [
        *_faults(timeline),
        *(Mark(t_ns, EVENT, event.text) for t_ns, event in timeline.events),
        *_growth(*timeline.loop.rows(0, 1 << 62), LOOP.index("overruns"), OVERRUN),
        *_rejected_frames(timeline),
        *_gated(timeline),
        *(Mark(t_ns, ADAPTED, f"belief {change.source}: {change.reason}") for t_ns, change in timeline.beliefs),
        *_spaced([Mark(t_ns, ADAPTED, it.text) for t_ns, it in timeline.adaptations if it.outcome in _INFORMATIVE]),
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


# Chosen: steps in which a replay can say what had been driven.
_STEP_NS = 500_000_000
ExcitationRows = Sequence[Mapping[str, Any]]


class Excited:
    """Coverage of a whole log, kept every half second; `driven` is False where nobody drove by hand."""

    def __init__(self, timeline: Timeline, top_rad_s: float) -> None:
        coverage = Coverage(top_rad_s)
        self._times: list[int] = []
        self._items: list[ExcitationRows] = []
        times, rows = timeline.command.rows(0, np.iinfo(np.int64).max)
        sources = list(timeline.source)
        self.driven = any(source == Source.MANUAL.value for _, source in sources)
        if not self.driven:
            return
        at = np.searchsorted([since for since, _ in sources], times, "right") - 1
        by_hand = np.array([source == Source.MANUAL.value for _, source in sources])[at]
        by_hand &= rows[:, COMMAND.index("in_force")] > 0.0
        wheels = rows[:, [COMMAND.index("left_rad_s"), COMMAND.index("right_rad_s")]].tolist()
        for t_ns, (left, right), counts in zip(times.tolist(), wheels, by_hand.tolist(), strict=True):
            if counts:
                coverage.add(t_ns, left, right)
            else:
                coverage.pause()
            if not self._times or t_ns - self._times[-1] >= _STEP_NS:
                self._times.append(t_ns)
                self._items.append(coverage.as_dict()["items"])

    def items(self, t_ns: int) -> ExcitationRows:
        """Return the motions driven so far, in the form of `Coverage.as_dict`; empty before the first command."""
        index = bisect_right(self._times, t_ns) - 1
        return self._items[index] if index >= 0 else ()
