"""Limit of open file descriptors, with some kept free for callers that must never fail to open one."""

from __future__ import annotations

import os
import resource
import threading
from collections.abc import Iterator
from contextlib import contextmanager


def free_descriptors() -> int:
    """Return how many more descriptors this process may open."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    most = 1 << 20 if limit == resource.RLIM_INFINITY else limit
    return most - len(os.listdir("/proc/self/fd"))


class DescriptorReserve:
    """Holds `count` descriptors that nobody else in this process can take, until `released` gives them up."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._reserved: list[int] = []
        self._fill()

    @contextmanager
    def released(self) -> Iterator[None]:
        """Free the reserve within the block and take it again afterwards, as far as there are descriptors."""
        with self._lock:
            self._free()
            try:
                yield
            finally:
                self._fill()

    def close(self) -> None:
        """Give the descriptors back; safe to call twice."""
        with self._lock:
            self._free()

    def _fill(self) -> None:
        while len(self._reserved) < self._count:
            try:
                self._reserved.append(os.eventfd(0, os.EFD_CLOEXEC))
            except OSError:
                return

    def _free(self) -> None:
        while self._reserved:
            os.close(self._reserved.pop())
