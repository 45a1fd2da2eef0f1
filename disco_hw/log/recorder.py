"""The recording side of the daemon: hands records to the writer's process and never waits for it.

What cannot be handed on is dropped and counted. The socket belongs to the thread that made the recorder.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import msgspec
import zmq

from disco_hw.log.errors import LogError
from disco_hw.log.link import ENCODE_ERRORS, END, Attachment, Start, WriterStatus, batch_encoder
from disco_hw.log.records import Record
from disco_hw.log.spawn import spawn_at_normal_priority

_STATUS_BYTES = 65_536


@dataclass(frozen=True, slots=True)
class RecorderStats:
    """Counters since the recorder was made; what the writer says of itself is as old as its last flush.

    `ticks` and `records` were handed on; `dropped_*` were not, because the writer was too slow or dead; `refused` could
    not be encoded or decoded. `written` and `bytes` are in the present file.
    """

    ticks: int = 0
    records: int = 0
    dropped_ticks: int = 0
    dropped_records: int = 0
    refused: int = 0
    written: int = 0
    bytes: int = 0
    writer_deaths: int = 0
    writer_alive: bool = False
    last_error: str = ""


class Recorder(Protocol):
    """Takes the records of each tick; no call but `close` waits for anything, and none raises on what it is given."""

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Record what happened in the tick at `now_ns`, in this order."""

    def poll(self) -> RecorderStats:
        """Look after the writer and return the counters; call it about once a second."""

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """End the log, wait at most `timeout_s` for the file to be whole, and return the final counters."""


class NullRecorder:
    """Records nothing."""

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Do nothing."""

    def poll(self) -> RecorderStats:
        """Counters of nothing."""
        return RecorderStats()

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """Counters of nothing."""
        return RecorderStats()


class MemoryRecorder:
    """Keeps every tick in `ticks` as (now_ns, records), for tests and for the harness in simulated time."""

    def __init__(self) -> None:
        self.ticks: list[tuple[int, tuple[Record, ...]]] = []

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Keep the tick."""
        self.ticks.append((now_ns, tuple(records)))

    def poll(self) -> RecorderStats:
        """Counters of what was kept."""
        return RecorderStats(ticks=len(self.ticks), records=sum(len(records) for _, records in self.ticks))

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """Counters of what was kept."""
        return self.poll()


def wall_offset_ns() -> int:
    """Wall-clock time minus monotonic time now, in ns; take it once, since the wall clock may step."""
    before = time.monotonic_ns()
    wall = time.time_ns()
    return wall - (before + time.monotonic_ns()) // 2


@dataclass(frozen=True, slots=True)
class Recording:
    """What a log begins with, and how much may wait for the writer (`queue_ticks`) before ticks are dropped."""

    path: Path
    robot: str
    version: str = ""
    attachments: tuple[Attachment, ...] = ()
    queue_ticks: int = 1000
    flush_s: float = 0.5
    silence_s: float = 10.0
    offset_ns: int = field(default_factory=wall_offset_ns)


class ProcessRecorder:
    """Records through a writer process of its own; it runs at normal priority and in a session of its own.

    Make it before the loop starts: starting a process takes milliseconds. Raises LogError when the log's directory
    cannot be made or the file already exists; every later failure is counted and shown by `poll`.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._encode = batch_encoder()
        self._decode_status = msgspec.json.Decoder(WriterStatus).decode
        self._part = 1
        self._sequence = 0
        self._ticks = 0
        self._records = 0
        self._dropped_ticks = 0
        self._dropped_records = 0
        self._refused = 0
        self._deaths = 0
        self._last_error = ""
        self._closing = False
        self._final = RecorderStats()
        self._status = WriterStatus("recording", 0, 0, 0)
        self._status_rest = b""
        self._process: subprocess.Popen[bytes] | None = None
        _prepare(recording.path)
        self._runtime = _runtime_directory()
        self._endpoint = f"ipc://{self._runtime}/log"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.PUSH)
        self._socket.setsockopt(zmq.SNDHWM, recording.queue_ticks)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RECONNECT_IVL, 20)
        try:
            # The recorder connects, so that batches queue while the writer starts.
            self._socket.connect(self._endpoint)
        except zmq.ZMQError as error:
            self._release()
            raise LogError(
                f"{self._runtime}: cannot hold a socket ({error.strerror}); set XDG_RUNTIME_DIR to a short path"
            ) from None
        try:
            self._launch()
        except LogError:
            self._release()
            raise

    @property
    def path(self) -> Path:
        """The file being written now."""
        if self._part == 1:
            return self._recording.path
        return self._recording.path.with_suffix(f".part{self._part}{self._recording.path.suffix}")

    @property
    def writer_pid(self) -> int | None:
        """The writer's process, or None once it has ended."""
        return None if self._process is None else self._process.pid

    def put(self, now_ns: int, records: Sequence[Record]) -> None:
        """Record what happened in the tick at `now_ns`, in this order; never blocks and never raises."""
        if not records:
            return
        self._sequence += 1
        try:
            message = self._encode(self._sequence, now_ns, records)
        except ENCODE_ERRORS:
            records = self._encodable(now_ns, records)
            message = self._encode(self._sequence, now_ns, records)
        try:
            if self._process is None:
                raise zmq.Again
            self._socket.send(message, zmq.NOBLOCK)
        except zmq.ZMQError:
            self._dropped_ticks += 1
            self._dropped_records += len(records)
        else:
            self._ticks += 1
            self._records += len(records)

    def poll(self) -> RecorderStats:
        """Read what the writer says, notice its death, and return the counters."""
        process = self._process
        if process is not None:
            # The exit is looked at before the status is read, so that nothing said before it is missed.
            code = process.poll()
            self._read_status(process)
            if code is not None:
                self._ended(process, code)
        return RecorderStats(
            ticks=self._ticks,
            records=self._records,
            dropped_ticks=self._dropped_ticks,
            dropped_records=self._dropped_records,
            refused=self._refused + self._status.refused,
            written=self._status.records,
            bytes=self._status.bytes,
            writer_deaths=self._deaths,
            writer_alive=self._process is not None,
            last_error=self._last_error,
        )

    def restart(self) -> bool:
        """Start a new writer with a new file part if the writer has died; True if one was started.

        Takes milliseconds: call it only while the robot is not armed. Raises LogError as the constructor does.
        """
        if self._closing or self.poll().writer_alive:
            return False
        self._part += 1
        _prepare(self.path)
        self._launch()
        return True

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """End the log and wait at most `timeout_s` for it; a writer still busy then finishes by itself."""
        if not self._closing:
            self._closing = True
            deadline = time.monotonic() + timeout_s
            self._send_end(deadline)
            if self._process is not None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(max(0.0, deadline - time.monotonic()))
            self._final = self.poll()
            self._release()
        return self._final

    def _send_end(self, deadline: float) -> None:
        while self.poll().writer_alive and time.monotonic() < deadline:
            with contextlib.suppress(zmq.Again):
                self._socket.send(END, zmq.NOBLOCK)
                return
            time.sleep(0.01)

    def _encodable(self, now_ns: int, records: Sequence[Record]) -> list[Record]:
        """The records that can be encoded; the others are counted."""
        kept = []
        for record in records:
            try:
                self._encode(0, now_ns, (record,))
            except ENCODE_ERRORS as error:
                self._refused += 1
                self._last_error = f"a {type(record).__name__} could not be recorded: {error}"
            else:
                kept.append(record)
        return kept

    def _launch(self) -> None:
        recording = self._recording
        start = Start(
            path=str(self.path.absolute()),
            endpoint=self._endpoint,
            robot=recording.robot,
            version=recording.version,
            part=self._part,
            parent_pid=os.getpid(),
            start_ns=time.monotonic_ns(),
            wall_offset_ns=recording.offset_ns,
            attachments=recording.attachments,
            flush_s=recording.flush_s,
            silence_s=recording.silence_s,
        )
        start_file = self._runtime / f"start{self._part}"
        try:
            start_file.write_bytes(msgspec.msgpack.encode(start))
        except OSError as error:
            raise LogError(f"{start_file}: cannot be written ({error.strerror}); make room there") from None
        command = [sys.executable, "-m", "disco_hw.log.writer", str(start_file)]
        self._status = WriterStatus("recording", 0, 0, 0)
        self._status_rest = b""
        self._process = spawn_at_normal_priority(command)

    def _read_status(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        with contextlib.suppress(BlockingIOError):
            while data := os.read(process.stdout.fileno(), _STATUS_BYTES):
                *lines, self._status_rest = (self._status_rest + data).split(b"\n")
                for line in lines[-1:]:
                    with contextlib.suppress(msgspec.MsgspecError):
                        self._status = self._decode_status(line)
        if self._status.error:
            self._last_error = self._status.error

    def _ended(self, process: subprocess.Popen[bytes], code: int) -> None:
        assert process.stdout is not None
        process.stdout.close()
        self._process = None
        self._refused += self._status.refused
        self._status = msgspec.structs.replace(self._status, refused=0)
        if self._status.state == "finished":
            if not self._closing:
                self._deaths += 1
                self._last_error = "the log writer heard nothing for too long and ended the file"
            return
        self._deaths += 1
        if self._status.state != "failed":
            how = f"signal {-code}" if code < 0 else f"exit status {code}"
            self._last_error = f"the log writer died ({how}); {self.path} holds what it had written"

    def _release(self) -> None:
        self._socket.close()
        self._context.term()
        if self._process is not None and self._process.stdout is not None:
            self._process.stdout.close()
        shutil.rmtree(self._runtime, ignore_errors=True)


def _prepare(path: Path) -> None:
    """Make the directory; refuse what the writer could not create."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LogError(
            f"{path.parent}: cannot be made ({error.strerror}); give a directory that can be written to"
        ) from None
    if path.exists():
        raise LogError(f"{path}: already exists and a log is never overwritten; give another name")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise LogError(f"{path.parent}: cannot be written to; give another directory or mend its permissions")


def _runtime_directory() -> Path:
    """A new directory for the socket, where sockets of this user live; mkdtemp makes it 0700, its owner's alone."""
    root = os.environ.get("XDG_RUNTIME_DIR", "")
    if not (root and os.access(root, os.W_OK | os.X_OK)):
        root = tempfile.gettempdir()
    try:
        return Path(tempfile.mkdtemp(prefix="disco-hw-", dir=root))
    except OSError as error:
        raise LogError(f"{root}: no directory can be made in it ({error.strerror}); set XDG_RUNTIME_DIR") from None
