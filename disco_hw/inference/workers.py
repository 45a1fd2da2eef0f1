"""Who does the work that can be shared out: this process's threads or a Dask cluster; and how far it is."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol, TypeVar

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


class Workers(Protocol):
    """Where work is done; it is pure, so the results are the same wherever that is."""

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """Results of `work(shared, item)` in the order of the items, as they come."""

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """The result of one piece of work."""


class LocalWorkers:
    """Threads on all cores this process may use, for work that gives up the interpreter's lock."""

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """As `Workers.map`."""
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            yield from pool.map(lambda item: work(shared, item), items)

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """As `Workers.call`, in the caller's thread."""
        return work(*arguments)


ReportProgress = Callable[[str, float], None]


class Tally:
    """Counts simulations of `total` and reports the stage with the share that is done, in [0, 1]."""

    def __init__(self, total: int, report_progress: ReportProgress) -> None:
        self._total = total
        self._report_progress = report_progress
        self._done = 0
        self._stage = ""

    def stage(self, text: str) -> None:
        """A new stage begins."""
        self._stage = text
        self.add(0)

    def add(self, count: int) -> None:
        """So many more simulations are done."""
        self._done += count
        self._report_progress(self._stage, min(self._done / self._total, 1.0))
