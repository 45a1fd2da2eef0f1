"""Recorder that hands records to the log writer's process and never waits for it.

What the writer has not confirmed is kept and given to the next one, should it end; what cannot be kept is dropped and
counted. A recorder belongs to the thread that made it.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from disco_hw.errors import LogError
from disco_hw.log import (
    ENCODE_ERRORS,
    STATES_IN_FORCE,
    TICK,
    Attachment,
    End,
    Start,
    TaskScene,
    WriterStatus,
    batch_encoder,
    frame,
)
from disco_hw.log.recorder import RecorderStats
from disco_hw.log.records import STATES, Record
from disco_hw.log.writer_link import Delivery, KeeperLink, WriterLine

# Chosen: catches up after a pause of the writer, without holding up the tick.
_SENT_PER_TICK = 16
# Chosen: a second at 50 Hz without a look at the writer's answers.
_UNREAD_TICKS = 50
# Chosen: shorter would report pauses of a slow disk; then the operator is told.
_SILENCE_S = 0.7
# Chosen: a writer that is silent for longer is ended and replaced.
_PATIENCE_S = 2.0
# Chosen: as long as a silent writer is waited for; a healthy disk takes milliseconds.
_SLOW_DISK_S = 2.0
# Chosen: longer, as the first writer loads its code from a cold disk.
_START_PATIENCE_S = 15.0
# Chosen: the exit code comes after the socket has closed; it says why.
_CAUSE_S = 0.3
# Chosen: at once after the first end, then ever more seldom, so that a full disk does not cost processor time.
_RETRY_S = (0.0, 1.0, 2.0, 5.0)
# Chosen: how often the end is looked for while the log closes.
_CLOSING_STEP_S = 0.02
_CLOSING_RETRY_S = 0.2
# Chosen: 3 h of driving or 9 h of standing. Until it ends the writer keeps up to 1.5 kB of index for each flush, which
# has 15 kB or more: so the size bounds its memory as well, to 0.1 GB.
_PART_BYTES = 1 << 30


def wall_offset_ns() -> int:
    """Wall-clock time minus monotonic time now, in ns; take it once, since the wall clock may step."""
    before = time.monotonic_ns()
    wall = time.time_ns()
    return wall - (before + time.monotonic_ns()) // 2


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Header of a log, and how many control cycles may wait for the writer (`queue_ticks`) before more are dropped.

    `planner`: version of the planner that the log's plans are of, 0 to name none. `part_bytes`: a file of this size is
    ended, and the log goes on in another part.
    """

    path: Path
    robot: str
    version: str = ""
    planner: int = 0
    attachments: tuple[Attachment, ...] = ()
    scene: TaskScene | None = None
    queue_ticks: int = 1000
    part_bytes: int = _PART_BYTES
    flush_s: float = 0.5
    offset_ns: int = field(default_factory=wall_offset_ns)


class ProcessRecorder:
    """Records through a writer process, which is replaced when it dies, freezes or cannot write, or its file is full.

    Make it before the loop starts: that takes as long as starting Python. A replacement is a fork of another process
    and costs the loop some microseconds; it begins a file of its own, with all that is not in the former one. Raises
    LogError if the file exists or cannot be made; later failures are counted, reported by `new_messages` and mended.
    """

    def __init__(self, recording: RecordingSettings) -> None:
        self._recording = recording
        self._encode = batch_encoder()
        self._delivery = Delivery(recording.queue_ticks)
        self._sequence = 0
        self._refused = 0
        self._deaths = 0
        self._last_error = ""
        self._messages: list[str] = []
        self._fault = ""
        self._retries = 0
        self._retry_s = 0.0
        self._patience_s = _PATIENCE_S
        self._next_part = 1
        self._continues = ""
        self._frozen = False
        self._slow_disk_reported = False
        self._end: bytes | None = None
        self._final: RecorderStats | None = None
        start = Start(
            path=str(recording.path.absolute()),
            robot=recording.robot,
            version=recording.version,
            planner=recording.planner,
            start_ns=0,
            wall_offset_ns=recording.offset_ns,
            attachments=recording.attachments,
            scene=recording.scene,
            flush_s=recording.flush_s,
        )
        self._start = start
        self._keeper = KeeperLink(start)
        self._line: WriterLine | None = None
        # The writer of a full part confirms what it was sent; then it writes the index while the next one records.
        self._part_ends = False
        self._finishing: WriterLine | None = None
        self._status = WriterStatus("recording", str(recording.path), 1)
        # Of the newest file that holds something: a writer that fails before its first tick leaves no file.
        self._kept_status = self._status
        self._await_first_writer()

    @property
    def path(self) -> Path:
        """The file being written now, or that was written last."""
        return Path(self._status.path)

    @property
    def writer_pid(self) -> int | None:
        """The writer's process, or None while there is none or it is not known yet."""
        return None if self._line is None else self._keeper.pid or None

    @property
    def keeper_pid(self) -> int | None:
        """The process that starts writers, or None once it has ended."""
        return self._keeper.process_pid

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
        if self._final is not None:
            self._delivery.drop(len(records))
            return
        states = tuple(record for record in records if type(record) in STATES)
        self._delivery.put(self._sequence, len(records), frame(TICK, message), states)
        self._send(_SENT_PER_TICK)
        if self._delivery.waiting_ticks > _UNREAD_TICKS:
            # Only for who never polls: each look costs some microseconds.
            self._read()

    def poll(self) -> RecorderStats:
        """Read what the writer says, replace it if it has ended or is silent for long, and return the counters."""
        if self._final is not None:
            return self._final
        self._exchange(_SENT_PER_TICK)
        self._look_after(time.monotonic())
        return self._stats()

    def new_messages(self) -> tuple[str, ...]:
        """Return messages about the recording since the last call, for the operator."""
        messages, self._messages = tuple(self._messages), []
        return messages

    def repair(self) -> None:
        """Start the keeper again if it has died or does not answer: takes milliseconds."""
        if self._final is None and self._keeper.needs_renewal(time.monotonic()):
            try:
                self._keeper.renew()
            except LogError as error:
                self._note(str(error))
                return
            self._note("the process that starts log writers ended or did not answer; it was restarted")
            if self._line is None or not self._line.has_received:
                self._line = None
                self._retry_s = 0.0

    def close(self, timeout_s: float = 5.0) -> RecorderStats:
        """End the log and wait at most `timeout_s` for it; a writer still busy then finishes by itself."""
        if self._final is None:
            deadline_s = time.monotonic() + timeout_s
            self._end = self._last_word(self._sequence)
            # There may be room again.
            self._retry_s = 0.0
            while self._is_busy and time.monotonic() < deadline_s:
                if self._delivery.waiting_ticks and (self._line is None or not self._line.has_received):
                    # It may have died while armed. A writer that records needs none.
                    self.repair()
                self._exchange(self._recording.queue_ticks)
                self._look_after(time.monotonic())
                self._wait(min(_CLOSING_STEP_S, max(0.0, deadline_s - time.monotonic())))
            self._report_losses()
            if not self._status.sequence:
                # A file that is being tried holds nothing yet; its writer deletes it when it fails after this.
                self._status = self._kept_status
            self._final = self._stats()
            if self._line is not None:
                self._line.close()
                self._line = None
            if self._finishing is not None:
                self._finishing.close()
                self._finishing = None
            self._keeper.close()
        return self._final

    @property
    def _is_busy(self) -> bool:
        """Whether ticks or a writer have yet to come to their end."""
        return self._line is not None or self._finishing is not None or self._delivery.waiting_ticks > 0

    def _await_first_writer(self) -> None:
        deadline_s = time.monotonic() + _START_PATIENCE_S
        self._launch()
        # The keeper and the writer report on lines of their own, in any order.
        while self._line is not None and not (self._line.recording and self._keeper.pid):
            self._exchange(0)
            if self._line.ended or time.monotonic() > deadline_s or not self._keeper.alive:
                error = self._line.status.error or (
                    f"{self._recording.path}: the log writer did not start; see the message above"
                )
                self._line.close()
                self._keeper.close()
                raise LogError(f"{error}; give another path with --log")
            self._wait(_CLOSING_STEP_S)

    def _encodable(self, now_ns: int, records: Sequence[Record]) -> list[Record]:
        """Return the records that can be encoded; the others are counted."""
        kept = []
        for record in records:
            try:
                self._encode(0, now_ns, (record,))
            except ENCODE_ERRORS as error:
                self._refused += 1
                self._note(f"a {type(record).__name__} could not be recorded: {error}")
            else:
                kept.append(record)
        return kept

    def _exchange(self, most: int) -> None:
        """Send what has not been sent, `most` ticks of it, and take in what writer and keeper say."""
        self._send(most)
        self._read()
        self._keeper.read()

    def _send(self, most: int) -> None:
        line, delivery = self._line, self._delivery
        if line is None or not line.send_rest() or self._part_ends:
            return
        if self._is_part_full(line.status):
            self._part_ends = True
            line.send_end(self._last_word(delivery.last_sent, continued=True))
            return
        for _ in range(most):
            following = delivery.next_frame()
            if following is None:
                break
            delivery.sent()
            if not line.send(following):
                return
        if self._end is not None and delivery.next_frame() is None:
            line.send_end(self._end)

    def _last_word(self, sequence: int, *, continued: bool = False) -> bytes:
        dropped = self._delivery.dropped_ticks
        return msgspec.msgpack.encode(End(time.monotonic_ns(), sequence, dropped, continued, wall_offset_ns()))

    def _is_part_full(self, status: WriterStatus) -> bool:
        """Whether the part is to be ended; not without a keeper, which starts the next writer."""
        full = status.sequence > 0 and status.bytes >= self._recording.part_bytes
        return full and self._end is None and self._finishing is None and self._keeper.alive

    def _read(self) -> None:
        line, delivery = self._line, self._delivery
        if line is None:
            return
        refusal = line.status.error
        if line.read():
            status = self._status = line.status
            delivery.acknowledge(status.sequence)
            if status.sequence:
                self._retries, self._patience_s = 0, _PATIENCE_S
                self._kept_status = status
            if status.state != "failed" and status.error and status.error != refusal:
                self._note(f"a record was refused by the log writer: {status.error}")
            self._report_slow_disk(status)

    def _look_after(self, now_s: float) -> None:
        self._look_after_finishing()
        if self._part_ends and self._delivery.is_confirmed:
            self._finishing = self._leave_part()
            self._retry_s = now_s
        line = self._line
        if line is None:
            if now_s >= self._retry_s and (self._end is None or self._delivery.waiting_ticks):
                self._launch()
            return
        if line.ended:
            code = self._keeper.code
            if line.status.state == "recording" and code is None and self._keeper.alive and line.silent_s < _CAUSE_S:
                return
            self._writer_ended(now_s, _cause(line, code))
            return
        silent_s = line.silent_s
        if line.ending and not self._delivery.waiting_ticks:
            return
        if silent_s < _SILENCE_S:
            if line.recording:
                self._recovered()
            return
        if line.has_received:
            self._fault = f"the log writer has not answered for {silent_s:.1f} s; new ticks are kept until it does"
            if not self._frozen:
                self._frozen = True
                self._note(self._fault)
        if silent_s >= (self._patience_s if line.has_received else _START_PATIENCE_S):
            pid = self._keeper.pid
            if pid:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            self._patience_s *= 2.0
            self._writer_ended(now_s, f"the log writer did not answer for {silent_s:.1f} s and was stopped")

    def _look_after_finishing(self) -> None:
        """Report if the index of the former part could not be written; its ticks are in the file."""
        line = self._finishing
        if line is not None:
            line.send_rest()
            line.read()
            if line.ended:
                if line.status.state != "finished":
                    self._note(_cause(line, None))
                line.close()
                self._finishing = None

    def _leave_part(self) -> WriterLine:
        """Let go of the present writer, so that the next one begins another part; returns the line to it."""
        line = self._line
        assert line is not None
        status = line.status
        self._line, self._frozen, self._part_ends = None, False, False
        self._refused += status.refused
        if status.deleted:
            self._delivery.file_deleted()
        if status.state == "failed" and not status.sequence:
            self._status = self._kept_status
        elif line.has_received:
            self._next_part = status.part + 1
            self._continues = status.path
        self._delivery.new_file()
        return line

    def _writer_ended(self, now_s: float, cause: str) -> None:
        line = self._leave_part()
        status = line.status
        line.close()
        if self._end is not None and status.state == "finished":
            self._recovered()
            return
        self._deaths += 1
        self._fault = f"nothing is being recorded: {cause}"
        pause_s = _RETRY_S[min(self._retries, len(_RETRY_S) - 1)]
        self._retry_s = now_s + (pause_s if self._end is None else min(pause_s, _CLOSING_RETRY_S))
        self._retries += 1
        self._note(cause)
        self._look_after(now_s)

    def _launch(self) -> None:
        request = msgspec.structs.replace(
            self._start,
            attachments=(),
            scene=None,
            part=self._next_part,
            start_ns=time.monotonic_ns(),
            continues=self._continues,
            continues_sequence=None if self._next_part == 1 else self._delivery.last_delivered,
        )
        fault = "the process that starts log writers has ended; disarm to restart it"
        try:
            connection = self._keeper.launch(request)
        except LogError as error:
            connection, fault = None, str(error)
        if connection is not None:
            self._line = WriterLine(connection, self._start.path, self._next_part)
            if self._delivery.states:
                states = self._encode(0, 0, tuple(self._delivery.states.values()))
                self._line.send(frame(STATES_IN_FORCE, states))
            self._next_part = max(2, self._next_part)
        else:
            self._retry_s = time.monotonic() + _RETRY_S[-1]
            self._fault = f"nothing is being recorded: {fault}"
            self._note(self._fault)

    def _recovered(self) -> None:
        """Report that ticks are in a file again, if they were not; a file without a tick may still come to nothing."""
        if self._fault and self._status.sequence:
            self._fault, self._frozen = "", False
            self._messages.append(f"recording goes on in {self._status.path}")

    def _report_slow_disk(self, status: WriterStatus) -> None:
        """Report, once, that the disk lags behind the file."""
        if status.sync_s >= _SLOW_DISK_S and not self._slow_disk_reported:
            self._slow_disk_reported = True
            self._messages.append(
                f"the disk has been storing the log for {status.sync_s:.1f} s; all is recorded, but a power cut now "
                "would lose what came since; use a faster disk, or stop other programs that write to it"
            )

    def _report_losses(self) -> None:
        """Report at the end how many ticks are in no file, and why."""
        stats = self._stats()
        if stats.missing_ticks:
            given = stats.ticks + stats.dropped_ticks
            slow = "too many ticks waited for a slow disk"
            busy = slow if not stats.waiting_ticks else "the log writer is still busy"
            self._fault = f"{stats.missing_ticks} of {given} ticks are not in the log: {self._last_error or busy}"
            self._messages.append(self._fault)

    def _note(self, sentence: str) -> None:
        """Report a failure, but not again while it only repeats itself."""
        if sentence not in self._messages and (sentence != self._last_error or self._retries <= 1):
            self._messages.append(sentence)
        self._last_error = sentence

    def _wait(self, timeout_s: float) -> None:
        """Wait for the writer, or until it can take more."""
        if self._line is None or self._line.ended:
            time.sleep(timeout_s)
            return
        full = [self._line] if self._line.full else []
        select.select([self._line], full, [], timeout_s)

    def _stats(self) -> RecorderStats:
        delivery, line, status = self._delivery, self._line, self._status
        return RecorderStats(
            ticks=delivery.ticks,
            records=delivery.records,
            dropped_ticks=delivery.dropped_ticks,
            dropped_records=delivery.dropped_records,
            delivered_ticks=delivery.delivered_ticks,
            waiting_ticks=delivery.waiting_ticks,
            lost_ticks=delivery.lost_ticks,
            refused=self._refused + (status.refused if line is not None and line.has_received else 0),
            written=status.records,
            bytes=status.bytes,
            writer_deaths=self._deaths,
            writer_alive=line is not None and line.recording,
            path=status.path,
            fault=self._fault,
            last_error=self._last_error,
        )


def _cause(line: WriterLine, code: int | None) -> str:
    """Return why a writer has ended, for the operator."""
    status = line.status
    if status.state == "failed":
        return status.error
    if status.state == "finished":
        return "the log writer was ended by another program"
    how = "" if code is None else f" (signal {-code})" if code < 0 else f" (exit status {code})"
    return f"the log writer died{how}; {status.path} holds what it had written"
