"""Machine code for the plant's inner loops."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

from numba import njit

from drivers.kernel_cache import kept_on_disk

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of numbers and arrays with numba; the machine code is kept on disk between processes.

    A compiled function may call only compiled functions of its own file: the cache on disk is renewed when that file
    changes, and not when another one does.
    """
    return cast(Callable[P, R], kept_on_disk(njit(nogil=True)(function)))
