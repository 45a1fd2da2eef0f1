"""Keeps compiled kernels on disk between processes, in a directory that is this user's alone.

What numba keeps there are pickles, which run what they say when they are loaded. It lies with the drivers because the
planner's kernels and the simulated plant share no other room.
"""

from __future__ import annotations

import fcntl
import os
import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

from numba import config, njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

from drivers.private_files import user_name, why_not_private

_Dispatcher = TypeVar("_Dispatcher")
_printed: set[str] = set()
_NOT_KEPT = "kernels are compiled again in each process, because no directory to keep them belongs to this user alone"
P = ParamSpec("P")
R = TypeVar("R")


def kept_on_disk(dispatcher: _Dispatcher) -> _Dispatcher:
    """Let a function that `njit` made load its machine code from disk and leave it there; returns the same function.

    The directory is $NUMBA_CACHE_DIR, else `__pycache__` beside the source, else the user's cache directory: the first
    that belongs to this user and that nobody else can write to. What lies in another is never read: the function is
    compiled anew, and a line on standard error says so.
    """
    compiled: Any = dispatcher
    try:
        compiled._cache = _KernelCache(compiled.py_func)
    except RuntimeError:
        _print_line(_NOT_KEPT)
    return dispatcher


def are_kernels_kept() -> bool:
    """Whether there was a directory for every function so far that was to be kept."""
    return _NOT_KEPT not in _printed


class _PrivateLocator:
    """Passes a directory over that is not this user's alone; to be mixed into numba's locators."""

    get_cache_path: Any

    def ensure_cache_path(self) -> None:
        os.makedirs(self.get_cache_path(), mode=0o700, exist_ok=True)
        super().ensure_cache_path()  # type: ignore[misc]

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        locator = super().from_function(py_func, py_file)  # type: ignore[misc]
        if locator is not None and (why := _why_not_believed(locator.get_cache_path())) is not None:
            _print_line(f"{why}; kernels there are not loaded but compiled again")
            return None
        return locator


class _KernelCacheImpl(CompileResultCacheImpl):
    def __init__(self, py_func: Any) -> None:
        bases = [(_PrivateLocator, locator) for locator in self._locator_classes]
        self._locator_classes: list[Any] = [type(base.__name__, (mixin, base), {}) for mixin, base in bases]
        super().__init__(py_func)  # type: ignore[no-untyped-call]


class _Index(IndexDataCacheFile):
    def _load_index(self) -> Any:
        try:
            return super()._load_index()  # type: ignore[no-untyped-call]
        except Exception:
            # Another version of the sources left it, with types that are elsewhere now: nothing is there.
            return {}

    def save(self, key: Any, data: Any) -> None:
        """Save a compiled form, while no other process saves one in this directory.

        Two that did so at a time would give two forms one file name, or drop one from the index.
        """
        directory = os.open(self._cache_path, os.O_RDONLY)
        try:
            fcntl.flock(directory, fcntl.LOCK_EX)
            super().save(key, data)  # type: ignore[no-untyped-call]
        finally:
            os.close(directory)


class _KernelCache(FunctionCache):
    _impl_class = _KernelCacheImpl

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)  # type: ignore[no-untyped-call]
        of = self._impl
        self._cache_file = _Index(self._cache_path, of.filename_base, of.locator.get_source_stamp())  # type: ignore[no-untyped-call]


def _why_not_believed(cache_path: str) -> str | None:
    """Return why the kernels in a directory could be another user's, with the path in front; None if they cannot."""
    directory = Path(os.path.realpath(cache_path))
    named: str = vars(config)["CACHE_DIR"]
    given = Path(os.path.realpath(named)) if named else directory
    try:
        for place in (directory, given):
            if (place in (directory, *directory.parents)) and (why := why_not_private(place, {os.geteuid()})):
                return f"{place}: {why}"
        for file in directory.glob("*.nb[ic]"):
            status = file.lstat()
            if status.st_uid != os.geteuid() or status.st_mode & stat.S_IWOTH:
                return f"{file}: belongs to {user_name(status.st_uid)} or can be written by others"
    except OSError as error:
        return f"{directory}: {error.strerror}"
    return None


def _print_line(line: str) -> None:
    if line not in _printed:
        _printed.add(line)
        print(f"disco-hw: {line}", file=sys.stderr)


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of numbers and arrays with numba; the machine code is kept on disk between processes.

    A compiled function may call only compiled functions of its own file: the cache on disk is renewed when that file
    changes, and not when another one does.
    """
    return cast(Callable[P, R], kept_on_disk(njit(nogil=True)(function)))
