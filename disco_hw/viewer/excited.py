"""What a drive by hand has excited up to an instant of its log, as `disco-hw drive` shows it while driving."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from disco_hw.drive.coverage import Coverage
from disco_hw.runtime.pipeline import Source
from disco_hw.viewer.timeline import COMMAND, Timeline

_STEP_NS = 500_000_000
Items = Sequence[Mapping[str, Any]]


class Excited:
    """Coverage of a whole log, kept every half second; `driven` is False where nobody drove by hand."""

    def __init__(self, timeline: Timeline, top_rad_s: float) -> None:
        coverage = Coverage(top_rad_s)
        self._times: list[int] = []
        self._items: list[Items] = []
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

    def items(self, t_ns: int) -> Items:
        """What counts and how much of it there is, as `Coverage.as_dict` says; empty before the first command."""
        index = bisect_right(self._times, t_ns) - 1
        return self._items[index] if index >= 0 else ()
