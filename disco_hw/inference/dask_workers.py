"""An existing Dask cluster as workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

from disco_hw.errors import InputError, WorkError

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")

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
