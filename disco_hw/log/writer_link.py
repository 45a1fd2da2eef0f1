"""The recorder's side of the log's processes: the keeper, a writer's socket, and which ticks have reached the file.

Only making a `KeeperLink` takes time; no other call waits.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress
from typing import NamedTuple

import msgspec

from disco_hw.errors import LogError
from disco_hw.log import END, MESSAGE_BYTES, Ended, Start, Started, WriterStatus, frame
from disco_hw.log.records import Record
from disco_hw.processes import spawn_at_normal_priority


class WriterLine:
    """Sends frames, of which one may be on its way in part, and keeps the newest status.

    `has_received`: a status has come. `ended`: the writer has hung up. `ending`: it has been sent the end. `full`: it
    cannot take more now.
    """

    def __init__(self, connection: socket.socket, path: str, part: int) -> None:
        self.status = WriterStatus("recording", path, part)
        self.has_received = False
        self.ended = False
        self.ending = False
        self._connection = connection
        self._rest = memoryview(b"")
        self._received = b""
        self._decode = msgspec.json.Decoder(WriterStatus).decode
        self._received_s = time.monotonic()

    @property
    def recording(self) -> bool:
        """Whether the writer said last that it records; what it says of a failure comes before it hangs up."""
        return self.has_received and not self.ended and self.status.state == "recording"

    @property
    def full(self) -> bool:
        """Whether a frame is on its way in part."""
        return bool(self._rest)

    @property
    def silent_s(self) -> float:
        """Time since anything came."""
        return time.monotonic() - self._received_s

    def fileno(self) -> int:
        """Return the socket's file descriptor, for `select`."""
        return self._connection.fileno()

    def send(self, data: bytes) -> bool:
        """Send a frame, the rest of it later if need be; False if no other can follow it now."""
        self._rest = memoryview(data)
        return self.send_rest()

    def send_rest(self) -> bool:
        """Send what is left of the last frame; True if nothing is left."""
        while self._rest and not self.ended:
            try:
                sent = self._connection.send(self._rest)
            except OSError:
                # Full, or gone: what it said last may still be waiting to be read, and that it has gone is found there.
                return False
            self._rest = self._rest[sent:]
        return not self._rest

    def send_end(self, payload: bytes) -> None:
        """Send the last frame, once."""
        if not self.ending:
            self.ending = True
            self.send(frame(END, payload))

    def read(self) -> bool:
        """Take in what the writer says; True if it said something."""
        if self.ended:
            return False
        try:
            data = self._connection.recv(MESSAGE_BYTES)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        if not data:
            self.ended = True
            return False
        self._received_s = time.monotonic()
        *lines, self._received = (self._received + data).split(b"\n")
        for line in lines[-1:]:
            with suppress(msgspec.MsgspecError):
                self.status = self._decode(line)
                self.has_received = True
        return bool(lines)

    def close(self) -> None:
        """Close the connection to the writer."""
        self._connection.close()


# Chosen: above a fork on a loaded computer.
_REPLY_TIMEOUT_S = 5.0
# Chosen: holds ticks while the writer's disk pauses; more are kept in the recorder.
_BUFFER_BYTES = 1 << 20


class KeeperLink:
    """Link to a keeper process, which starts writers that begin their logs with `start`.

    Raises LogError if it cannot be started.

    `pid` is the newest writer's, 0 until it is known; `code` how that one ended, negative for a signal.
    """

    def __init__(self, start: Start) -> None:
        self._start = start
        self._decode = msgspec.msgpack.Decoder(Started | Ended).decode
        self.pid = 0
        self.code: int | None = None
        self._requested_s: float | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._open_writer()

    @property
    def alive(self) -> bool:
        """Whether the keeper has not hung up."""
        return self._channel is not None

    @property
    def process_pid(self) -> int | None:
        """The keeper's own process."""
        return self._process.pid if self._process is not None and self.alive else None

    def needs_renewal(self, now_s: float) -> bool:
        """Whether the keeper process is dead, or has not started a requested writer in time."""
        return not self.alive or (self._requested_s is not None and now_s - self._requested_s > _REPLY_TIMEOUT_S)

    def launch(self, request: Start) -> socket.socket | None:
        """Ask for a writer; returns the recorder's end of the socket to it, or None without a keeper.

        Raises LogError where this process may not open a socket.
        """
        if self._channel is None:
            return None
        try:
            ours, theirs = socket.socketpair()
        except OSError as error:
            raise _refused(error) from None
        with theirs:
            ours.setblocking(False)
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            try:
                socket.send_fds(self._channel, [msgspec.msgpack.encode(request)], [theirs.fileno()])
            except OSError:
                ours.close()
                self._hang_up()
                return None
        self.pid, self.code = 0, None
        self._requested_s = time.monotonic()
        return ours

    def read(self) -> None:
        """Take in what the keeper says, and notice its death."""
        while self._channel is not None:
            try:
                data = self._channel.recv(MESSAGE_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._hang_up()
                return
            message = self._decode(data)
            if isinstance(message, Started):
                self.pid, self._requested_s = message.pid, None
            elif message.pid == self.pid:
                self.code = message.code

    def renew(self) -> None:
        """Start another keeper in place of this one; takes milliseconds. The writer lives on. Raises LogError."""
        self._end_process()
        try:
            self._open_writer()
        except OSError as error:
            raise _refused(error) from None

    def close(self) -> None:
        """Let the keeper end; safe to call twice."""
        self._hang_up()
        if self._process is not None:
            try:
                self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                self._end_process()
            self._process = None

    def _open_writer(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        # The attachments are too long for a message, and the place for logs may have no room for a file.
        memory = os.memfd_create("log-start")
        try:
            with theirs, os.fdopen(memory, "wb", closefd=False) as file:
                ours.setblocking(False)
                file.write(msgspec.msgpack.encode(self._start))
                file.flush()
                descriptors = (theirs.fileno(), memory)
                command = [sys.executable, "-m", "disco_hw.log.writer", *map(str, descriptors)]
                self._process = spawn_at_normal_priority(command, pass_fds=descriptors)
        except LogError:
            ours.close()
            raise
        finally:
            os.close(memory)
        self._channel = ours
        self._requested_s = None

    def _hang_up(self) -> None:
        if self._channel is not None:
            self._channel.close()
            self._channel = None

    def _end_process(self) -> None:
        self._hang_up()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


def _refused(error: OSError) -> LogError:
    return LogError(f"no log writer can be started ({error.strerror}); end what uses up this computer's open files")


class _Parcel(NamedTuple):
    """One tick on its way: its number, its frame, and those of its records that hold until the next of their type."""

    sequence: int
    frame: bytes
    states: tuple[Record, ...]


class Delivery:
    """Keeps each tick until the writer says that it is in the file; a new writer is sent again what was not.

    given = delivered + lost + waiting + dropped, in ticks. `dropped_ticks`: `most` were waiting already. `lost_ticks`:
    they were in a file that was deleted. `states`: of each type of `STATES` the last one that was delivered.
    """

    def __init__(self, most: int) -> None:
        self.ticks = 0
        self.records = 0
        self.dropped_ticks = 0
        self.dropped_records = 0
        self.lost_ticks = 0
        self.delivered_ticks = 0
        self.last_delivered = 0
        self.states: dict[type, Record] = {}
        self._most = most
        self._waiting: deque[_Parcel] = deque()
        self._sent = 0
        self._in_file = 0

    @property
    def waiting_ticks(self) -> int:
        """Ticks that were taken and are not in a file yet."""
        return len(self._waiting)

    @property
    def is_confirmed(self) -> bool:
        """Whether all that the present writer was sent is in its file."""
        return not self._sent

    @property
    def last_sent(self) -> int:
        """Number of the last tick that the present writer was sent, or that was delivered before; 0 if none was."""
        return self._waiting[self._sent - 1].sequence if self._sent else self.last_delivered

    def put(self, sequence: int, records: int, frame: bytes, states: tuple[Record, ...] = ()) -> None:
        """Take a tick, or drop it."""
        if len(self._waiting) >= self._most:
            self.drop(records)
            return
        self.ticks += 1
        self.records += records
        self._waiting.append(_Parcel(sequence, frame, states))

    def drop(self, records: int) -> None:
        """Count a tick that is not taken."""
        self.dropped_ticks += 1
        self.dropped_records += records

    def next_frame(self) -> bytes | None:
        """Return the first frame that the present writer has not been sent."""
        return self._waiting[self._sent].frame if self._sent < len(self._waiting) else None

    def sent(self) -> None:
        """Mark a frame as sent completely."""
        self._sent += 1

    def acknowledge(self, sequence: int) -> None:
        """Note that all ticks up to this number that were sent are in the present file."""
        while self._sent and self._waiting[0].sequence <= sequence:
            self.states |= {type(state): state for state in self._waiting.popleft().states}
            self._sent -= 1
            self._in_file += 1
            self.delivered_ticks += 1
        self.last_delivered = max(self.last_delivered, sequence)

    def new_file(self) -> None:
        """Note that another writer begins another file: it gets what is in none."""
        self._sent = 0
        self._in_file = 0

    def file_deleted(self) -> None:
        """Count the control cycles of the current file as lost, because the file was deleted."""
        self.lost_ticks += self._in_file
        self.delivered_ticks -= self._in_file
        self._in_file = 0
