"""Who does the work that can be shared out: this process's threads or a Dask cluster; and how far it is."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Protocol, TypeVar

from disco_hw.errors import InputError, WorkError

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


_CONNECT_TIMEOUT_S = 5.0


class DaskWorkers:
    """Work on the cluster of a connected `distributed.Client`; what is shared is sent to its workers once a call."""

    def __init__(self, client: Any) -> None:
        self._client = client

    def map(self, work: Callable[[S, T], R], shared: S, items: Sequence[T]) -> Iterator[R]:
        """As `Workers.map`."""
        sent = self._client.scatter(shared, broadcast=True, hash=False)
        for future in self._client.map(_swapped, list(items), work=work, shared=sent, pure=False):
            yield future.result()

    def call(self, work: Callable[..., R], *arguments: Any) -> R:
        """As `Workers.call`."""
        result: R = self._client.submit(work, *arguments, pure=False).result()
        return result


def _swapped(item: T, work: Callable[[S, T], R], shared: S) -> R:
    return work(shared, item)


@contextmanager
def dask_workers(address: str) -> Iterator[DaskWorkers]:
    """Connect to the scheduler at `address`, e.g. tcp://host:8786; the cluster is left as it was.

    Raises InputError if dask is not installed, nothing answers, or the cluster has no workers; WorkError if the cluster
    is lost on the way or its workers cannot do the work.
    """
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise InputError("--dask: dask is not installed; pip install 'disco-hw[dask]'") from None
    try:
        client = distributed.Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(
            f"--dask {address}: no scheduler answers there ({reason}); give its address, e.g. tcp://host:8786"
        ) from None
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(f"--dask {address}: the cluster has no workers; start some with `dask worker {address}`")
        try:
            yield DaskWorkers(client)
        except ModuleNotFoundError as error:
            raise WorkError(f"--dask {address}: a worker lacks {error.name}; install disco-hw there too") from None
        except (distributed.KilledWorker, distributed.client.FutureCancelledError, OSError) as error:
            reason = str(error).partition("\n")[0]
            raise WorkError(f"--dask {address}: the cluster was lost ({reason}); start it again, then infer") from None
