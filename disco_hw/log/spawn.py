"""Starts the writer's process from a thread that may be in the real-time class, without handing that class on."""

from __future__ import annotations

import contextlib
import os
import subprocess
import threading
from collections.abc import Sequence

from disco_hw.errors import LogError


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
