"""How the processes of disco-hw are set up: one thread in numeric libraries, and children at a normal priority."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass

from disco_hw.errors import LogError

_THREAD_COUNT_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


_LIBC = ctypes.CDLL(None)
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
    """One measure: whether it was taken, and a line for a person with the remedy where it was not."""

    name: str
    done: bool
    text: str

    def __str__(self) -> str:
        return f"{self.name}: {self.text}"


def limit_thread_pools(environment: MutableMapping[str, str] = os.environ) -> Step:
    """Hold the numeric libraries to one thread each; must come before they are imported to bind all of them.

    Torch and numba are also held if they are imported already; a BLAS that is loaded keeps the threads it has.
    """
    numpy_is_late = "numpy" in sys.modules and environment.get("OPENBLAS_NUM_THREADS") != "1"
    for name in _THREAD_COUNT_VARIABLES:
        # Numba reads its variable again at each compilation and raises if it then differs from the threads it has.
        if not (name.startswith("NUMBA") and "numba" in sys.modules):
            environment[name] = "1"
    for module_name, function in (("torch", "set_num_threads"), ("numba", "set_num_threads")):
        module = sys.modules.get(module_name)
        if module is not None:
            getattr(module, function)(1)
    if numpy_is_late:
        return Step("threads", False, "numpy was loaded before; start with OPENBLAS_NUM_THREADS=1 in the environment")
    return Step("threads", True, "numeric libraries use one thread")


def spawn_at_normal_priority(command: list[str], pass_fds: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start a process that never runs in the real-time class, whatever the caller's is; its output can be read.

    A child inherits the scheduling of the thread that makes it, and a child at the loop's priority would take its core
    from the loop while it starts; so a thread made for it gives the priority up first. Its own session keeps the
    terminal's Ctrl-C from it; it keeps the descriptors `pass_fds`. Standard output is a pipe that does not block its
    reader. Raises LogError.
    """
    made: list[subprocess.Popen[bytes]] = []
    failed: list[OSError] = []

    def spawn() -> None:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
            if os.getpriority(os.PRIO_PROCESS, 0) < 0:
                os.setpriority(os.PRIO_PROCESS, 0, 0)
        try:
            made.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    start_new_session=True,
                    pass_fds=tuple(pass_fds),
                )
            )
        except OSError as error:
            failed.append(error)

    thread = threading.Thread(target=spawn, name="log-writer-start")
    thread.start()
    thread.join()
    if failed:
        raise LogError(f"{command[0]}: cannot start the log writer ({failed[0].strerror}); mend the installation")
    process = made[0]
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    return process
