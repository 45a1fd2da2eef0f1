"""What a start does before it matters: compiles kernels that no earlier start has kept, and warms the tick up.

In a process of its own, which is gone afterwards: the compiler leaves 200 MB behind, and the control loop's process
locks all that it has.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from numba.core import event

from disco_hw.processes import end_with_parent
from disco_hw.runtime.pipeline import FollowTask, Off, Pipeline, Stand
from drivers.kernel_cache import are_kernels_kept
from drivers.types import PoseSample, Readings, WheelSample

T = TypeVar("T")

_COMPILE = "numba:compile"
_EVERY_S = 1.0


class _Compilation(event.Listener):
    """Counts the functions that are compiled, and says so again and again from a thread that begins with the first."""

    def __init__(self, what: str, say: Callable[[str], None], every_s: float) -> None:
        self._what, self._say, self._every_s = what, say, every_s
        self._count = 0
        self._began_ns = 0
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    def on_start(self, event: Any) -> None:
        if self._thread is None:
            self._say(f"compiling {self._what}: about a minute, this once; the result is kept for the next start")
            self._began_ns = time.monotonic_ns()
            self._thread = threading.Thread(target=self._tell, name="compile progress", daemon=True)
            self._thread.start()

    def on_end(self, event: Any) -> None:
        self._count += 1

    def finish(self) -> None:
        """End the thread, and say how long it took if anything was compiled."""
        self._ended.set()
        if self._thread is not None:
            self._thread.join()
            self._say(f"compiled {self._so_far()}")

    def _tell(self) -> None:
        while not self._ended.wait(self._every_s):
            self._say(f"compiling: {self._so_far()}")

    def _so_far(self) -> str:
        return f"{self._count} functions, {(time.monotonic_ns() - self._began_ns) * 1e-9:.0f} s"


@contextmanager
def compile_progress(what: str, say: Callable[[str], None], every_s: float = _EVERY_S) -> Iterator[None]:
    """Within the block, say through `say` what numba compiles and how far it is; nothing where its cache has it all.

    `what`: for a person, as "the planner for a circle". `say` is called from a thread, which ends with the block.
    """
    compilation = _Compilation(what, say, every_s)
    try:
        with event.install_listener(_COMPILE, compilation):
            yield
    finally:
        compilation.finish()


class _NothingKeptError(Exception):
    """Something would have been compiled."""


class _Refusal(event.Listener):
    """Ends the first compilation before it begins."""

    def on_start(self, event: Any) -> None:
        raise _NothingKeptError

    def on_end(self, event: Any) -> None:
        pass


def compiled_elsewhere(make: Callable[[], T], what: str, say: Callable[[str], None]) -> T:
    """Return `make()`, after another process has compiled and kept on disk all that it needs.

    `make` is called up to three times, once in a fork of this process; so it must open nothing, and no thread may run
    yet. Where nothing can be kept, or the other process fails, this process compiles by itself. `what` and `say` as
    for `compile_progress`.
    """
    if are_kernels_kept():
        try:
            with event.install_listener(_COMPILE, _Refusal()):
                return make()
        except _NothingKeptError:
            _make_in_a_fork(make, what, say)
    with compile_progress(what, say):
        return make()


def _make_in_a_fork(make: Callable[[], object], what: str, say: Callable[[str], None]) -> None:
    parent = os.getpid()

    def compile_all() -> None:
        end_with_parent(parent, signal.SIGKILL)
        # Whatever is wrong is found, and said, by the caller's own attempt.
        with suppress(Exception), compile_progress(what, say):
            make()

    process = multiprocessing.get_context("fork").Process(target=compile_all, daemon=True)
    process.start()
    try:
        process.join()
    finally:
        process.kill()


_PERIOD_NS = 20_000_000
_POSE_DELAY_NS = 30_000_000
_TICKS = 60
_WHEEL_RAD_S = 2.0
_ON_THE_WAY = 20


def warm_up(pipeline: Pipeline) -> None:
    """Drive a pipeline that is thrown away afterwards through standing, driving, late and absurd poses."""
    pipeline.step(0, Readings(), Off())
    for tick in range(1, _TICKS):
        now_ns = tick * _PERIOD_NS
        pipeline.step(now_ns, _readings(now_ns, tick), FollowTask() if tick > _ON_THE_WAY else Stand())
        pipeline.rollouts(1)


def _readings(now_ns: int, tick: int) -> Readings:
    speed = _WHEEL_RAD_S if tick > _ON_THE_WAY else 0.0
    angle = _WHEEL_RAD_S * max(0, tick - _ON_THE_WAY) * _PERIOD_NS * 1e-9
    wheels = WheelSample(now_ns, now_ns, angle, 1.5 * angle, speed, 1.5 * speed)
    far_off = math.nan if tick == _TICKS - 2 else 1.0 if tick == _TICKS - 3 else 0.0
    pose = PoseSample(now_ns - _POSE_DELAY_NS, now_ns, far_off, 0.06 * angle, 0.5 * math.pi, 0.005, 0.01)
    return Readings(wheels=(wheels,), poses=(pose,) if tick > 1 else ())
