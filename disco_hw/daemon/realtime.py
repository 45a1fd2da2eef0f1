"""Makes this process a real-time one as far as the system allows, and says plainly what it did not allow.

Measured on a loaded two-core machine at 50 Hz, these steps together move the worst wake-up from 13 ms to 3.5 ms late;
a second thread in the numeric libraries alone loses nearly every deadline, because the loop then waits for a worker
of normal priority.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
from collections.abc import Callable, Collection
from pathlib import Path

from disco_hw.errors import InputError
from disco_hw.processes import Step

_SWITCH_INTERVAL_S = 0.0005
_MCL_CURRENT = 1
_MCL_FUTURE = 2
_CAP_IPC_LOCK = 14
_CAP_SYS_NICE = 23
_OTHER_THREADS_BELOW = 10
_STOLEN_COLUMN = 8
_M_ARENA_MAX = -8
_PTHREAD_ATTRIBUTES_BYTES = 64
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
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_ARENA_MAX, 1)
    attributes = ctypes.create_string_buffer(_PTHREAD_ATTRIBUTES_BYTES)
    libc.pthread_attr_init(attributes)
    libc.pthread_attr_setstacksize(attributes, ctypes.c_size_t(_STACK_BYTES))
    if hasattr(libc, "pthread_setattr_default_np"):
        libc.pthread_setattr_default_np(attributes)
    libc.pthread_attr_destroy(attributes)


def enter(priority: int, cpus: Collection[int] = ()) -> tuple[Step, ...]:
    """Take every measure, in the order that lets threads made later inherit them; never raises for a refused one.

    To be called when everything is imported, warmed up and allocated, before the link's threads are made, and after
    other processes were started: children inherit the scheduler too. The calling thread gets SCHED_FIFO 10 below
    `priority` (at least 1), for the threads to inherit; `raise_loop_thread` gives the loop its own. `priority` 0
    leaves the scheduler and the memory alone. `cpus`: the only CPUs to run on, all if empty.
    """
    steps = [_set_switch_interval(), _freeze_garbage()]
    if cpus:
        steps.append(_try("cpus", lambda: os.sched_setaffinity(0, cpus), f"runs on {sorted(cpus)}", "name CPUs it has"))
    if priority == 0:
        return (*steps, Step("scheduler", False, "left alone, as daemon.realtime_priority is 0"))
    steps.append(_lock_memory())
    steps.append(_set_fifo("scheduler", max(1, priority - _OTHER_THREADS_BELOW)))
    return tuple(steps)


def raise_loop_thread(priority: int) -> Step:
    """Give the calling thread SCHED_FIFO at `priority` (1 to 98), above the threads made since `enter`."""
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


def _set_switch_interval() -> Step:
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    return Step("interpreter", True, f"a thread gives way within {_SWITCH_INTERVAL_S * 1e3:g} ms")


def _freeze_garbage() -> Step:
    gc.collect()
    gc.freeze()
    gc.disable()
    return Step("garbage collector", True, f"off, {gc.get_freeze_count()} objects frozen")


def _lock_memory() -> Step:
    if not can_lock_memory():
        # Under a finite limit the lock may succeed now and make a later allocation fail in mid-run.
        remedy = "set LimitMEMLOCK=infinity in the service, or a memlock line in /etc/security/limits.conf"
        return Step("memory", False, f"not locked, as the limit is finite; {remedy}")
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


def _try(name: str, action: Callable[[], None], done: str, remedy: str) -> Step:
    try:
        action()
    except (OSError, ValueError) as error:
        return Step(name, False, f"refused ({getattr(error, 'strerror', None) or error}); {remedy}")
    return Step(name, True, done)


def _has_capability(number: int) -> bool:
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("CapEff:"):
            return bool(int(line.split()[1], 16) >> number & 1)
    return False
