"""The processes that write the log: a keeper, made before the loop runs, and the writers that it forks.

`python -m disco_hw.log.writer CHANNEL START` is the keeper; both arguments are descriptors. It has imported all that a
writer needs, so that the control loop, which may ask for a writer at any moment, starts no process itself. It ends with
the recorder's process, and signals to end are not for it: a service manager sends them to all processes at once.

A writer lives as long as the recorder's process needs it: it ends the file properly on the recorder's last word or when
that process is gone. SIGTERM only sets it a time limit, as the last second of driving, the stop, is still to come then.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import msgspec

from disco_hw.log import END, MESSAGE_BYTES, STATES_IN_FORCE, End, Ended, Frames, Start, Started, WriterStatus
from disco_hw.log.mcap_log import McapLog

# EX_CANTCREAT and EX_IOERR of sysexits.h.
EXIT_CANNOT_CREATE = 73
EXIT_CANNOT_WRITE = 74

# Chosen: many ticks in one call.
_RECEIVE_BYTES = 1 << 18
# Chosen: a status stays shorter than MESSAGE_BYTES.
_LONGEST_ERROR = 300
# Chosen: a directory that holds so many parts is no place to go on in.
_MOST_PARTS = 1000


class LogFile:
    """A new file, unbuffered; raises OSError, FileExistsError among them: a log is never overwritten."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._written = 0
        self._complete_bytes = 0
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
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._written

    def flush(self) -> None:
        """Note that what has been written is whole: nothing is buffered."""
        self._complete_bytes = self._written

    def sync(self) -> None:
        """Return when what was written is on the disk."""
        os.fsync(self._fd)

    @property
    def deleted(self) -> bool:
        """Whether no directory names the file any more."""
        return os.fstat(self._fd).st_nlink == 0

    def truncate_to_complete(self) -> None:
        """Drop what came after the last flush, so that the file holds what was confirmed and nothing else."""
        os.ftruncate(self._fd, self._complete_bytes)
        self._written = self._complete_bytes

    def close(self) -> None:
        """Close the file of the log."""
        os.close(self._fd)


class BackgroundSync:
    """Brings a file to the disk on a thread of its own, because a slow disk can take seconds for it."""

    def __init__(self, file: LogFile) -> None:
        self._file = file
        self._thread = ThreadPoolExecutor(1)
        self._running: Future[None] | None = None
        self._begun_s = 0.0

    def start(self) -> None:
        """Begin to bring to the disk what is written; raises OSError if the last attempt failed.

        While the last one still runs, nothing is begun.
        """
        if self._running is not None:
            if not self._running.done():
                return
            self._running.result()
        self._begun_s = time.monotonic()
        self._running = self._thread.submit(self._file.sync)

    def finish(self) -> None:
        """Return when all is on the disk; raises OSError if that failed, now or in the last attempt."""
        if self._running is not None:
            # The kernel reports a failure to the first caller only.
            self._running.result()
        self._file.sync()

    @property
    def pending_s(self) -> float:
        """Time for which the disk has been busy with the running attempt, in s; 0 if none runs."""
        return 0.0 if self._running is None or self._running.done() else time.monotonic() - self._begun_s


class StatusLine:
    """Status to the recorder; a recorder that is gone or does not read costs nothing."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._rest = b""

    def send(self, status: WriterStatus) -> None:
        """Send one line, or drop it; a long error is cut, and the rest of a line goes before the next."""
        status = msgspec.structs.replace(status, error=status.error[:_LONGEST_ERROR])
        line = self._rest or msgspec.json.encode(status) + b"\n"
        with contextlib.suppress(OSError):
            self._rest = line[self._connection.send(line, socket.MSG_DONTWAIT) :]


class Session:
    """One log from its first byte to its last: socket in, file out; every method raises OSError from the file."""

    def __init__(self, start: Start, connection: socket.socket, file: LogFile, line: StatusLine) -> None:
        self._start = start
        self._connection = connection
        self._file = file
        self._sync = BackgroundSync(file)
        self._line = line
        self._frames = Frames()
        self._grace_ends_s: float | None = None
        self._log = McapLog(file, start)
        self._file.sync()
        self._report("recording")

    @property
    def sequence(self) -> int:
        """Number of the last tick in the file; 0 if there is none."""
        return self._log.flushed_sequence

    def terminate(self) -> None:
        """End within the grace time even if the recorder does not say so."""
        if self._grace_ends_s is None:
            self._grace_ends_s = time.monotonic() + self._start.grace_s

    def run(self) -> None:
        """Write ticks until the recorder ends or is gone, then the index."""
        now_s = time.monotonic()
        next_flush_s, next_beat_s = now_s + self._start.flush_s, now_s + self._start.beat_s
        ended = False
        while not ended:
            ended = self._receive(max(0.0, min(next_flush_s, next_beat_s) - time.monotonic()))
            now_s = time.monotonic()
            if now_s >= next_flush_s:
                self._flush()
                now_s = time.monotonic()
                next_flush_s = now_s + self._start.flush_s
            if now_s >= next_beat_s:
                self._report("recording")
                next_beat_s = now_s + self._start.beat_s
            ended = ended or (self._grace_ends_s is not None and now_s > self._grace_ends_s)
        self._finish()

    def _receive(self, timeout_s: float) -> bool:
        """Wait for ticks and write them; True if no more will come."""
        if not select.select([self._connection], [], [], timeout_s)[0]:
            return False
        try:
            data = self._connection.recv(_RECEIVE_BYTES)
        except OSError:
            data = b""
        self._frames.add(data)
        before = self.sequence
        for kind, payload in self._frames:
            if kind == END:
                self._log.end(msgspec.msgpack.decode(payload, type=End))
                return True
            if kind == STATES_IN_FORCE:
                self._log.begin_with(payload)
            else:
                self._log.write(payload)
        if self.sequence != before:
            self._report("recording")
        return not data

    def _flush(self) -> None:
        """Hand all to the file, and let the disk take its time to make it outlive a power cut."""
        self._log.flush()
        self._report("recording")
        self._sync.start()
        self._check_exists()

    def _finish(self) -> None:
        """Write the index and return when all is on the disk."""
        # The index of a large file takes seconds, and the recorder begins the next part when it knows that all is here.
        self._log.flush()
        self._report("recording")
        self._log.finish()
        self._report("recording")
        self._sync.finish()
        self._check_exists()
        self._report("finished")

    def _check_exists(self) -> None:
        if self._file.deleted:
            raise FileNotFoundError("it was deleted while it was being written, and its content is lost")

    def _report(self, state: Literal["recording", "finished"]) -> None:
        log, start = self._log, self._start
        self._line.send(
            WriterStatus(
                state, start.path, start.part, self.sequence, log.records, log.flushed_refused, self._file.tell(),
                log.last_refusal, sync_s=self._sync.pending_s,
            )
        )  # fmt: skip


def run(start: Start, connection: socket.socket) -> int:
    """Record to a new file; return the exit status. `start.path` is the first part's, and so is its number."""
    line = StatusLine(connection)
    try:
        start, file = _create(start)
    except OSError as error:
        fault = f"{start.path}: cannot be created ({_reason(error)})"
        line.send(WriterStatus("failed", start.path, start.part, error=fault))
        return EXIT_CANNOT_CREATE
    sequence = 0
    try:
        session = Session(start, connection, file, line)
        signal.signal(signal.SIGTERM, lambda *_: session.terminate())
        try:
            session.run()
        finally:
            sequence = session.sequence
    except OSError as error:
        _give_up(start, file, line, error, sequence)
        return EXIT_CANNOT_WRITE
    finally:
        file.close()
    return 0


def _create(start: Start) -> tuple[Start, LogFile]:
    """Make the file, and its directory where it has gone; a later part takes the next name that is free."""
    first = Path(start.path)
    first.parent.mkdir(parents=True, exist_ok=True)
    if start.part == 1:
        return start, LogFile(first)
    for part in range(start.part, start.part + _MOST_PARTS):
        path = first.with_suffix(f".part{part}{first.suffix}")
        with contextlib.suppress(FileExistsError):
            return msgspec.structs.replace(start, path=str(path), part=part), LogFile(path)
    raise FileExistsError(f"there are {_MOST_PARTS} parts already")


def _give_up(start: Start, file: LogFile, line: StatusLine, error: OSError, sequence: int) -> None:
    """Leave what is whole in the file, and no file that holds nothing."""
    deleted = file.deleted
    with contextlib.suppress(OSError):
        file.truncate_to_complete()
        if not sequence and not deleted:
            os.unlink(start.path)
    line.send(
        WriterStatus(
            "failed", start.path, start.part, sequence, bytes=file.tell(), deleted=deleted,
            error=f"{start.path}: {'' if deleted else 'cannot be written: '}{_reason(error)}",
        )
    )  # fmt: skip


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


def keep(channel: socket.socket, start: Start) -> None:
    """Start a writer for each request until the other end of the channel is closed."""
    living: dict[int, int] = {}
    while True:
        readable, _, _ = select.select([channel.fileno(), *living], [], [])
        for descriptor in [descriptor for descriptor in living if descriptor in readable]:
            pid = living.pop(descriptor)
            os.close(descriptor)
            _, how = os.waitpid(pid, 0)
            _send_message(channel, Ended(pid, os.waitstatus_to_exitcode(how)))
        if channel.fileno() not in readable:
            continue
        try:
            message, descriptors, _, _ = socket.recv_fds(channel, MESSAGE_BYTES, 1)
        except OSError:
            return
        if not message:
            return
        connection = socket.socket(fileno=descriptors[0])
        request = msgspec.msgpack.decode(message, type=Start)
        try:
            pid = os.fork()
        except OSError as error:
            fault = f"{request.path}: no process can be made to write it ({_reason(error)})"
            StatusLine(connection).send(WriterStatus("failed", request.path, request.part, error=fault))
            connection.close()
            _send_message(channel, Started(0))
            continue
        if pid == 0:
            # A writer that kept these would hide the end of the keeper and of other writers.
            for descriptor in living:
                os.close(descriptor)
            channel.close()
            _write(msgspec.structs.replace(request, attachments=start.attachments, scene=start.scene), connection)
        connection.close()
        living[os.pidfd_open(pid)] = pid
        _send_message(channel, Started(pid))


def _write(start: Start, connection: socket.socket) -> None:
    """Be a writer, and end as one."""
    code = 1
    try:
        code = run(start, connection)
    except Exception:
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(code)


def _send_message(channel: socket.socket, message: Started | Ended) -> None:
    """Report to the recorder; one that is gone or does not read costs nothing."""
    with contextlib.suppress(OSError):
        channel.send(msgspec.msgpack.encode(message), socket.MSG_DONTWAIT)


def main() -> int:
    """Read what every log begins with, and keep the writers."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # The recorder's process may block signals that it takes another way; that would have been inherited.
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    if len(sys.argv) != 3 or not all(argument.isdecimal() for argument in sys.argv[1:]):
        print("usage: python -m disco_hw.log.writer CHANNEL START (it is started by the recorder)", file=sys.stderr)
        return 2
    with os.fdopen(int(sys.argv[2]), "rb") as file:
        file.seek(0)
        start = msgspec.msgpack.decode(file.read(), type=Start)
    keep(socket.socket(fileno=int(sys.argv[1])), start)
    return 0


if __name__ == "__main__":
    sys.exit(main())
