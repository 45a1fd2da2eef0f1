"""A log opened for looking at: its timeline in memory, its plans read when one is needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError
from disco_hw.log.reader import Log
from disco_hw.log.records import TOPICS, FrameIn, FrameOut, Plan
from disco_hw.runtime.pipeline import Source
from disco_hw.viewer.snapshot import PLAN_AGE_NS, Snapshot, snapshot_at
from disco_hw.viewer.stage import Stage, stage_of_log
from disco_hw.viewer.timeline import Timeline
from drivers.types import MotorSample

_UNSEEN = (FrameIn, FrameOut, MotorSample)
_DRIVING = frozenset({Source.PLAN.value, Source.MANUAL.value})
_SHOWN = tuple(topic.name for topic in TOPICS if topic.record not in _UNSEEN)


class Recording:
    """An open log with its robot; `ticks` (N,) are the times of its ticks, ns. Close it, or use it in `with`."""

    def __init__(self, path: Path, robot_file: Path | None = None) -> None:
        self._log = Log(path)
        try:
            if "/estimate" not in self._log.counts:
                raise InputError(f"{path}: holds no estimates, so there is nothing to show; give a log of `run`")
            self.stage: Stage = stage_of_log(self._log, robot_file)
            self.timeline = Timeline()
            for now_ns, record in self._log.brief_records(_SHOWN):
                self.timeline.add(now_ns, record)
            self.ticks: NDArray[np.int64] = self.timeline.estimate.rows(0, np.iinfo(np.int64).max)[0]
        except BaseException:
            self._log.close()
            raise

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; safe to call twice."""
        self._log.close()

    @property
    def first_ns(self) -> int:
        """Time of the first tick."""
        return int(self.ticks[0])

    @property
    def duration_s(self) -> float:
        """From the first tick to the last."""
        return float(self.ticks[-1] - self.ticks[0]) * 1e-9

    @property
    def task_start_s(self) -> float:
        """Seconds from the first tick to the first that drives: by the task's plan, or by hand; 0 if none does."""
        driven = (t_ns for t_ns, source in self.timeline.source if source in _DRIVING)
        return (next(driven, self.first_ns) - self.first_ns) * 1e-9

    def at(self, t_s: float) -> Snapshot:
        """The instant of the last tick at or before `t_s` seconds from the first; the ends beyond them."""
        t_ns = int(self.ticks[self.tick_at(t_s)])
        return snapshot_at(self.timeline, t_ns, self._plan_at(t_ns))

    def tick_at(self, t_s: float) -> int:
        """Number of the last tick at or before `t_s`, from 0 on."""
        t_ns = self.first_ns + round(t_s * 1e9)
        return min(max(int(np.searchsorted(self.ticks, t_ns, "right")) - 1, 0), len(self.ticks) - 1)

    def seconds_of(self, tick: int) -> float:
        """Seconds from the first tick to this one."""
        return float(self.ticks[min(max(tick, 0), len(self.ticks) - 1)] - self.first_ns) * 1e-9

    def _plan_at(self, t_ns: int) -> Plan | None:
        newest = None
        for entry in self._log.records(("/plan",), t_ns - PLAN_AGE_NS, t_ns + 1):
            newest = entry.record
        return newest if isinstance(newest, Plan) else None
