"""Recording processes to kill: a process that records like the daemon does, and waiting for what it brings about."""

import gc
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest

from disco_hw.log import writer, writer_link
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.reader import open_log
from tests.drivers import waiting
from tools.log_samples import ATTACHMENTS, tick


def recording(path, **changes):
    given = {"path": path, "robot": "wombot", "attachments": ATTACHMENTS, "flush_s": 0.05}
    return RecordingSettings(**(given | changes))


def recorded_ticks(path):
    """Ticks of the control loop that a log holds."""
    with open_log(path) as log:
        return [entry.tick for entry in log.records(("/loop",))]


wait_until = partial(waiting.wait_until, timeout_s=60.0)


@contextmanager
def files_of_at_most(size):
    """Let this process write no file beyond `size` bytes, as on a full disk."""
    resource.prlimit(0, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        yield
    finally:
        resource.prlimit(0, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def alive(pid):
    """Whether a process runs; one that has ended but was not reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def size(path):
    return path.stat().st_size if path.exists() else 0


def drive(recorder, first, count, period_s=0.0):
    """Put ticks numbered from `first`; return the times at which they were put."""
    times = []
    for k in range(first, first + count):
        times.append(time.monotonic_ns())
        recorder.put(times[-1], tick(k, times[-1]))
        time.sleep(period_s)
    return times


class ForkedProcess:
    """A fork of this process that calls `work`, as to start Python and import our code costs more than most tests."""

    def __init__(self, work, pass_fds=()):
        self.pid = os.fork()
        if self.pid == 0:
            try:
                os.setsid()
                for number in set(map(int, os.listdir("/proc/self/fd"))) - {1, 2, *pass_fds}:
                    with suppress(OSError):
                        os.close(number)
                gc.freeze()
                work()
            finally:
                os._exit(0)

    def kill(self):
        os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout=60.0):
        deadline_s = time.monotonic() + timeout
        while not os.waitpid(self.pid, os.WNOHANG)[0]:
            if time.monotonic() > deadline_s:
                raise subprocess.TimeoutExpired("forked process", timeout)
            time.sleep(0.001)


class ForkedKeeper(ForkedProcess):
    """A keeper of the recorder in this process."""

    def __init__(self, command, pass_fds=()):
        def keep():
            sys.argv = command[-3:]
            writer.main()

        super().__init__(keep, pass_fds)


class RecordingProcess:
    """A process that records [first:last] of each sample tick, and prints its number, until it is killed."""

    def __init__(self, path, first=0, last=99):
        said, say = os.pipe()
        self.process = ForkedProcess(partial(self._record, path, slice(first, last), say), (say,))
        os.close(say)
        self.said = os.fdopen(said)
        self.writer_pid, self.keeper_pid = map(int, self.said.readline().split())

    @staticmethod
    def _record(path, which, say):
        writer_link.spawn_at_normal_priority = ForkedKeeper
        recorder = ProcessRecorder(recording(path))
        os.write(say, f"{recorder.writer_pid} {recorder.keeper_pid}\n".encode())
        for k in range(1, 100_000):
            now_ns = time.monotonic_ns()
            recorder.put(now_ns, tick(k, now_ns)[which])
            recorder.poll()
            os.write(say, f"{k}\n".encode())
            time.sleep(0.005)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        self.said.close()
        wait_until(lambda: not alive(self.writer_pid) and not alive(self.keeper_pid))


class SmallDisk:
    """A directory on a file system of its own, of so many kB; skips the test where none can be mounted."""

    def __init__(self, directory, kilobytes):
        self.path = directory / "disk"
        self.path.mkdir()
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(self.path)],
            capture_output=True,
            check=False,
        )
        if mounted.returncode:
            pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.decode().strip()}")

    def __enter__(self):
        return self.path

    def __exit__(self, *_):
        subprocess.run(["umount", "--lazy", str(self.path)], check=True)
