"""Set-up of the processes of disco-hw: threads of the numeric libraries, children, real time, free descriptors.

Measured on a loaded two-core machine at 50 Hz, the steps of `enter_real_time` together move the worst wake-up from 13
ms to 3.5 ms late; a second thread in the numeric libraries alone loses nearly every deadline, because the loop then
waits for a worker of normal priority.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from disco_hw.errors import InputError, LogError

_COUNTED_BY = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "NUMBA_NUM", "VECLIB_MAXIMUM")
"""Of the environment, with _THREADS after each: how many threads a numeric library makes."""
_LIBC = ctypes.CDLL(None)
# linux/prctl.h.
_PR_SET_PDEATHSIG = 1
PARENT_VARIABLE = "DISCO_HW_ENDS_WITH"
"""Of the environment: the process id of the parent with which a `disco-hw` that is started shall end."""


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """Have Linux send this process a signal when its parent ends, however that ends; an exec keeps it.

    `parent`: its process id; if that is gone already, the signal comes at once. To be called in the child. "Ends" means
    the thread that made the child.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os.kill(os.getpid(), number)


@dataclass(frozen=True, slots=True)
class Step:
    """Result of one measure: whether it was taken, and a line for the operator with the remedy where it was not."""

    name: str
    done: bool
    text: str

    def __str__(self) -> str:
        return f"{self.name}: {self.text}"


def limit_thread_pools() -> None:
    """Hold the numeric libraries to one thread each; must come before they are imported to bind all of them.

    Torch and numba are also held if they are imported already; a BLAS that is loaded keeps the threads it has.
    """
    for name in _COUNTED_BY:
        # Numba reads its variable again at each compilation and raises if it then differs from the threads it has.
        if not (name.startswith("NUMBA") and "numba" in sys.modules):
            os.environ[f"{name}_THREADS"] = "1"
    for name in ("torch", "numba"):
        if (module := sys.modules.get(name)) is not None:
            module.set_num_threads(1)


def spawn_at_normal_priority(command: list[str], pass_fds: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start a process that never runs in the real-time class, whatever the caller's is; it has no input and output.

    A child inherits the scheduling of the thread that makes it, and a child at the loop's priority would take its core
    from the loop while it starts; so a thread made for it gives the priority up first. Its own session keeps the
    terminal's Ctrl-C from it; it keeps the descriptors `pass_fds`. Raises LogError.
    """

    def spawn() -> subprocess.Popen[bytes]:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            if os.getpriority(os.PRIO_PROCESS, 0) < 0:
                os.setpriority(os.PRIO_PROCESS, 0, 0)
        none = subprocess.DEVNULL
        return subprocess.Popen(command, stdin=none, stdout=none, start_new_session=True, pass_fds=pass_fds)

    try:
        with ThreadPoolExecutor(1, thread_name_prefix="log-writer-start") as thread:
            return thread.submit(spawn).result()
    except OSError as error:
        raise LogError(
            f"{command[0]}: cannot start the log writer ({error.strerror}); repair the installation"
        ) from None


# Chosen: short beside a tick of 20 ms, in which the loop may wait for another thread.
SWITCH_INTERVAL_S = 0.0005
# sys/mman.h; linux/capability.h.
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_CAP_IPC_LOCK = 14
_CAP_SYS_NICE = 23
# Chosen: the loop comes before its process's other threads, and these before other programs.
_OTHER_THREADS_BELOW = 10
# proc(5): `steal` in the first line of /proc/stat.
_STOLEN_COLUMN = 8
# malloc.h of glibc; room for its pthread_attr_t, of 56 bytes on x86-64 and 64 on AArch64.
_M_ARENA_MAX = -8
_PTHREAD_ATTRIBUTES_BYTES = 64
# Chosen: where memory is locked, each thread's stack counts whole.
_STACK_BYTES = 1 << 20
# The loop compiles nothing: of its 150 MB it needs none.
_COMPILER = "libllvmlite"
_LEAST_ADDRESS_SPACE_BYTES = 1_000_000_000


def spare_memory() -> None:
    """Have what is to be locked stay small: one heap for all threads, and stacks of 1 MiB.

    By itself the C library reserves 64 MiB for the heap of each thread and 8 MiB for its stack, and all of it counts as
    locked. To be called before the first thread is made. Raises InputError where the process may not have the memory
    that a daemon needs, which would otherwise end in some library.
    """
    limit_bytes = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit_bytes != resource.RLIM_INFINITY and limit_bytes < _LEAST_ADDRESS_SPACE_BYTES:
        raise InputError(
            f"address space: limited to {limit_bytes / 1e6:.0f} MB, and compiling and driving take up to "
            f"{_LEAST_ADDRESS_SPACE_BYTES / 1e6:.0f} MB; raise it with `ulimit -v unlimited` or LimitAS= in the service"
        )
    _LIBC.mallopt(_M_ARENA_MAX, 1)
    attributes = ctypes.create_string_buffer(_PTHREAD_ATTRIBUTES_BYTES)
    _LIBC.pthread_attr_init(attributes)
    _LIBC.pthread_attr_setstacksize(attributes, ctypes.c_size_t(_STACK_BYTES))
    if hasattr(_LIBC, "pthread_setattr_default_np"):
        _LIBC.pthread_setattr_default_np(attributes)
    _LIBC.pthread_attr_destroy(attributes)


def enter_real_time(priority: int) -> tuple[Step, ...]:
    """Take every measure, in the order that lets threads made later inherit them; never raises for a refused one.

    To be called when everything is imported, warmed up and allocated, before the link's threads are made, and after
    other processes were started: children inherit the scheduler too. The calling thread gets SCHED_FIFO 10 below
    `priority` (at least 1), for the threads to inherit; `raise_loop_thread` gives the loop its own. `priority` 0
    leaves the scheduler and the memory alone.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    gc.disable()
    steps = [
        Step("interpreter", True, f"a thread gives way within {SWITCH_INTERVAL_S * 1e3:g} ms"),
        Step("garbage collector", True, f"off, {gc.get_freeze_count()} objects frozen"),
    ]
    if priority == 0:
        return (*steps, Step("scheduler", False, "unchanged, because daemon.realtime_priority is 0"))
    steps.append(_lock_memory())
    steps.append(_set_fifo("scheduler", max(1, priority - _OTHER_THREADS_BELOW)))
    return tuple(steps)


def raise_loop_thread(priority: int) -> Step:
    """Give the calling thread SCHED_FIFO at `priority` (1 to 98), above the threads made since `enter_real_time`."""
    return _set_fifo("loop thread", priority)


def stolen_ms(statistics: Path = Path("/proc/stat")) -> int:
    """CPU time since boot, of all CPUs, that the host of a virtual machine gave to others while a process wanted it.

    No measure above helps against it: what a loop loses so, it loses to another machine. 0 on hardware of one's own.
    """
    line = statistics.read_text(encoding="ascii").split("\n", 1)[0].split()
    ticks = int(line[_STOLEN_COLUMN]) if len(line) > _STOLEN_COLUMN else 0
    return ticks * 1000 // os.sysconf("SC_CLK_TCK")


def can_use_fifo() -> bool:
    """Whether SCHED_FIFO is allowed to this process, without using it."""
    return _has_capability(_CAP_SYS_NICE) or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] != 0


def can_lock_memory() -> bool:
    """Whether all memory, present and future, may be locked, without locking it."""
    unlimited = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    return _has_capability(_CAP_IPC_LOCK) or unlimited


def _lock_memory() -> Step:
    if not can_lock_memory():
        # Under a finite limit the lock may succeed now and make a later allocation fail in mid-run.
        hint = "set LimitMEMLOCK=infinity in the service, or a memlock line in /etc/security/limits.conf"
        return Step("memory", False, f"not locked, as the limit is finite; {hint}")
    libc = ctypes.CDLL(None, use_errno=True)

    def lock() -> None:
        # What compiling has left behind goes back first.
        libc.malloc_trim(0)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        for start, end in _mappings(_COMPILER):
            libc.munlock(ctypes.c_void_p(start), ctypes.c_size_t(end - start))

    return _try("memory", lock, "locked", "free some memory")


def _mappings(library: str) -> list[tuple[int, int]]:
    """First address and the one after the last of each part of this process's memory that is a file of this name."""
    lines = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    found = [line.split()[0].split("-") for line in lines if library in line.rpartition("/")[2]]
    return [(int(start, 16), int(end, 16)) for start, end in found]


def _set_fifo(name: str, priority: int) -> Step:
    return _try(
        name,
        lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority)),
        f"SCHED_FIFO {priority}",
        "set LimitRTPRIO=99 in the service, or an rtprio line in /etc/security/limits.conf",
    )


def _try(name: str, action: Callable[[], None], done: str, hint: str) -> Step:
    try:
        action()
    except (OSError, ValueError) as error:
        return Step(name, False, f"refused ({getattr(error, 'strerror', None) or error}); {hint}")
    return Step(name, True, done)


def _has_capability(number: int) -> bool:
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> number & 1)
    return False


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
