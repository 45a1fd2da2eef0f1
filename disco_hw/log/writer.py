"""The process that writes the log: `python -m disco_hw.log.writer START_FILE`, started by the recorder.

It lives as long as the recorder's process needs it: it ends the file properly on the recorder's end message, when that
process is gone, or after a long silence. SIGINT is ignored (it is meant for the recorder's process) and SIGTERM only
sets a time limit: a service manager sends it to all processes at once, and the last second of driving, the stop, is
still to come then.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from typing import Literal

import msgspec
import zmq

from disco_hw.log.link import END, EXIT_CANNOT_CREATE, EXIT_CANNOT_WRITE, Start, WriterStatus
from disco_hw.log.mcap_log import McapLog

_RECEIVE_HIGH_WATER = 256
_LARGEST_BURST = 64
_ORPHAN_DRAIN_S = 0.1
_LONGEST_ERROR = 300


class LogFile:
    """A new file, unbuffered; raises OSError, FileExistsError among them: a log is never overwritten."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._written = 0
        self._whole = 0
        directory = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(directory)
        finally:
            os.close(directory)

    def write(self, data: bytes) -> int:
        """Append all of the bytes."""
        view = memoryview(data)
        while view:
            count = os.write(self._fd, view)
            self._written += count
            view = view[count:]
        # The library writes whole records at a time.
        self._whole = self._written
        return len(data)

    def tell(self) -> int:
        """The number of bytes written."""
        return self._written

    def flush(self) -> None:
        """Do nothing: nothing is buffered."""

    def sync(self) -> None:
        """Return when what was written is on the disk."""
        os.fsync(self._fd)

    def cut_to_whole(self) -> None:
        """Drop a half-written end, so that the file ends with a whole record."""
        os.ftruncate(self._fd, self._whole)
        self._written = self._whole

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)


class StatusLine:
    """Status to the recorder over standard output; a recorder that is gone or does not read costs nothing."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        os.set_blocking(fd, False)

    def send(self, status: WriterStatus) -> None:
        """Write one line, or drop it; a long error is cut, so that a line is written whole or not at all."""
        status = msgspec.structs.replace(status, error=status.error[:_LONGEST_ERROR])
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._fd, msgspec.json.encode(status) + b"\n")


class Deadlines:
    """When to stop waiting for the recorder: pure, all times in monotonic ns."""

    def __init__(self, start: Start, now_ns: int) -> None:
        self._parent_pid = start.parent_pid
        self._silence_ns = round(start.silence_s * 1e9)
        self._grace_ns = round(start.grace_s * 1e9)
        self._last_message_ns = now_ns
        self._terminated_ns: int | None = None

    def heard(self, now_ns: int) -> None:
        """A message came."""
        self._last_message_ns = now_ns

    def terminate(self, now_ns: int) -> None:
        """A request to end came; the first one counts."""
        if self._terminated_ns is None:
            self._terminated_ns = now_ns

    def orphaned(self, parent_pid: int) -> bool:
        """Whether the recorder's process is gone."""
        return parent_pid != self._parent_pid

    def passed(self, now_ns: int) -> bool:
        """Whether to end the file although the recorder has not said so."""
        silent = now_ns - self._last_message_ns > self._silence_ns
        asked = self._terminated_ns is not None and now_ns - self._terminated_ns > self._grace_ns
        return silent or asked


class Session:
    """One log from its first byte to its last: socket in, file out; every method raises OSError from the file."""

    def __init__(self, start: Start, socket: zmq.Socket[bytes], file: LogFile, status: StatusLine) -> None:
        self._start = start
        self._socket = socket
        self._file = file
        self._status = status
        self._deadlines = Deadlines(start, time.monotonic_ns())
        self._log = McapLog(file, start)
        self._flush("recording")

    def terminate(self) -> None:
        """End within the grace time even if the recorder does not say so."""
        self._deadlines.terminate(time.monotonic_ns())

    def run(self) -> None:
        """Write batches until the recorder ends, then the index."""
        flush_ns = round(self._start.flush_s * 1e9)
        next_flush_ns = time.monotonic_ns() + flush_ns
        ended = False
        while not ended:
            timeout_ms = max(0, (next_flush_ns - time.monotonic_ns()) // 1_000_000)
            if self._socket.poll(timeout_ms):
                ended = self._take_burst()
                self._deadlines.heard(time.monotonic_ns())
            if time.monotonic_ns() < next_flush_ns:
                continue
            self._flush("recording")
            now_ns = time.monotonic_ns()
            next_flush_ns = now_ns + flush_ns
            if self._deadlines.orphaned(os.getppid()):
                while not ended and self._socket.poll(round(_ORPHAN_DRAIN_S * 1e3)):
                    ended = self._take_burst()
                ended = True
            ended = ended or self._deadlines.passed(now_ns)
        self._log.finish()
        self._flush("finished")

    def _flush(self, state: Literal["recording", "finished"]) -> None:
        if state == "recording":
            self._log.flush()
        self._file.sync()
        log = self._log
        self._status.send(WriterStatus(state, log.records, log.refused, self._file.tell(), log.last_refusal))

    def _take_burst(self) -> bool:
        """Write what is waiting, so much at most that the flush stays on time; True at the end message."""
        for _ in range(_LARGEST_BURST):
            try:
                message = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return False
            if message == END:
                return True
            self._log.write(message)
        return False


def run(start: Start) -> int:
    """Record to a new file; return the exit status and say on standard error what went wrong."""
    status = StatusLine(sys.stdout.fileno())
    path = Path(start.path)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.PULL)
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVHWM, _RECEIVE_HIGH_WATER)
    try:
        socket.bind(start.endpoint)
        file = LogFile(path)
    except (OSError, zmq.ZMQError) as error:
        return _fail(status, EXIT_CANNOT_CREATE, f"{path}: cannot be created ({_reason(error)})", 0)
    try:
        session = Session(start, socket, file, status)
        signal.signal(signal.SIGTERM, lambda *_: session.terminate())
        session.run()
    except OSError as error:
        file.cut_to_whole()
        return _fail(status, EXIT_CANNOT_WRITE, f"{path}: cannot be written ({_reason(error)})", file.tell())
    finally:
        file.close()
        socket.close()
        context.term()
    if os.getppid() != start.parent_pid:
        _remove_runtime_directory(Path(start.endpoint.removeprefix("ipc://")))
    return 0


def _remove_runtime_directory(socket_file: Path) -> None:
    """Clear up after a recorder that cannot any more."""
    with contextlib.suppress(OSError):
        socket_file.unlink(missing_ok=True)
        socket_file.parent.rmdir()


def _reason(error: OSError | zmq.ZMQError) -> str:
    return error.strerror or str(error)


def _fail(status: StatusLine, code: int, message: str, written: int) -> int:
    with contextlib.suppress(OSError):
        print(f"log writer: {message}", file=sys.stderr, flush=True)
    status.send(WriterStatus("failed", 0, 0, written, message))
    return code


def main() -> int:
    """Read the start file named on the command line, remove it, and record."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The recorder's process may block signals that it takes another way; that would have been inherited.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    if len(sys.argv) != 2:
        print("usage: python -m disco_hw.log.writer START_FILE (it is started by the recorder)", file=sys.stderr)
        return 2
    start_file = Path(sys.argv[1])
    try:
        start = msgspec.msgpack.decode(start_file.read_bytes(), type=Start)
    except (OSError, msgspec.MsgspecError) as error:
        print(f"log writer: {start_file}: not a start file ({error})", file=sys.stderr)
        return 2
    start_file.unlink(missing_ok=True)
    return run(start)


if __name__ == "__main__":
    sys.exit(main())
