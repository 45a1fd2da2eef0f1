"""Opens a log, whole or cut short, and gives its records back typed and in the order in which they were recorded."""

from __future__ import annotations

import contextlib
import glob
import math
import os
from collections.abc import Callable, Collection, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, open_file
from disco_hw.log import End
from disco_hw.log.container import (
    ChunkRef,
    Contents,
    DamagedError,
    Message,
    messages,
    read_attachment,
    read_chunk,
    read_contents,
)
from disco_hw.log.encoding import JsonDecoder
from disco_hw.log.mcap_log import ENDING, FORMAT, METADATA, RECOVERY, Metadata, from_text
from disco_hw.log.records import TOPIC_BY_NAME, PlanFigures, Record

Column = NDArray[np.generic]


def to_columns(record_type: type[Record], now_ns: Sequence[int], records: Sequence[Record]) -> dict[str, Column]:
    """One array for each field of N records, and `now_ns` (N,): numbers as int64, float64 or bool, text as objects.

    Tuples of one common length k become (N, k), of several lengths an object array of arrays; a mapping becomes a
    column `field.key` for every key found, float64 with NaN where a record lacks it.
    """
    columns: dict[str, Column] = {"now_ns": np.asarray(now_ns, dtype=np.int64)}
    for name in record_type.__struct_fields__:
        values = [getattr(record, name) for record in records]
        if values and isinstance(values[0], dict):
            for key in sorted({key for value in values for key in value}):
                columns[f"{name}.{key}"] = _column([value.get(key, math.nan) for value in values])
        else:
            columns[name] = _column(values)
    return columns


def _column(values: list[Any]) -> Column:
    if not values:
        return np.empty(0)
    if isinstance(values[0], tuple):
        return _tuples(values)
    kinds = {type(value) for value in values}
    if kinds == {bool}:
        return np.asarray(values, dtype=np.bool_)
    if kinds == {int}:
        return np.asarray(values, dtype=np.int64)
    if kinds <= {int, float}:
        return np.asarray(values, dtype=np.float64)
    return _objects(values)


def _tuples(values: list[tuple[Any, ...]]) -> Column:
    lengths = {len(value) for value in values}
    numeric = all(isinstance(item, float | int) for value in values for item in value)
    if len(lengths) == 1 and numeric:
        return np.asarray(values, dtype=np.float64)
    return _objects([np.asarray(value, dtype=np.float64) for value in values] if numeric else values)


def _objects(values: list[Any]) -> Column:
    column = np.empty(len(values), dtype=object)
    column[:] = values
    return column


_R = TypeVar("_R")
_T = TypeVar("_T")
# Times are int64 in our records.
_EARLIEST_NS, _LATEST_NS = -(2**63), 2**63 - 1
_NO_TIME = "a time or count in it is beyond 64 bits; leave this log out"
_RECOVER = "run `disco-hw log recover` and use the recovered log"


class Entry(NamedTuple):
    """One record as it was recorded: in the tick at `now_ns` (monotonic), the `tick`-th that the recorder was given."""

    topic: str
    now_ns: int
    tick: int
    record: Record


class Gap(NamedTuple):
    """Ticks that were dropped on their way to the file: how many, and when the first one after them was.

    In an import, a change of segment leaves out a tick's number as well.
    """

    before_ns: int
    ticks: int


class TopicSummary(msgspec.Struct, frozen=True):
    """Number of messages of one topic, and their mean rate."""

    count: int
    rate_hz: float


class LogSummary(msgspec.Struct, frozen=True):
    """Contents of a log, and what is known of its end.

    `missing_ticks` were given to the recorder and are not in the file: between its ticks, before the first as far as
    the former part says, and after the last where the log was ended. `segment_breaks`: of an import, how often a new
    segment begins. `ended`: the recorder ended it, at `end`; None for
    a log from before that was recorded. `wall_clock_change_s`: time by which the wall clock was ahead of the log's
    wall-clock times then. `continued`: as the file was full, and the log goes on in another part.
    `complete`: its index is there. `continues`: the former part. `damage`: what of the file is lost.
    """

    path: str
    bytes: int
    complete: bool
    ended: bool | None
    end: str
    wall_clock_change_s: float
    continued: bool
    continues: str
    robot: str
    version: str
    part: int
    start: str
    duration_s: float
    ticks: int
    missing_ticks: int
    segment_breaks: int
    topics: dict[str, TopicSummary]
    attachments: dict[str, int]
    damage: tuple[str, ...]


class Log:
    """Open log, to be used in a `with` statement. Times are monotonic ns unless the name says wall.

    Reading raises LogError on a damaged chunk of a log that is complete otherwise; of a log without its index the
    damaged chunks have been left out already, and `damage` says so.

    `complete`: the file has its index, as a writer leaves it that came to its end. `ending`: the recorder's last word;
    None if there is none, as the daemon or its recorder was gone before.
    """

    def __init__(self, path: Path) -> None:
        self._fd = open_file(path, LOG)
        self.path = path
        try:
            self._contents = _contents(self._fd, path)
            self.metadata = _metadata(self._contents, path)
            self.ending = _named(self._contents, ENDING, End)
        except BaseException:
            self.close()
            raise
        self.complete = self._contents.complete
        self._decoder = JsonDecoder()
        self._last_tick = 0
        self._topics = {
            channel.id: channel.topic
            for channel in self._contents.channels.values()
            if channel.topic in TOPIC_BY_NAME and channel.message_encoding == "json"
        }

    def __enter__(self) -> Log:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the log's file; safe to call twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    @property
    def damage(self) -> tuple[str, ...]:
        """Description of lost data; in a recovered log, of what the recovery could not copy."""
        recovered = [record.metadata.get("lost", "") for record in self._contents.metadata if record.name == RECOVERY]
        return (*self._contents.damage, *(line for text in recovered for line in text.splitlines()))

    @property
    def is_import(self) -> bool:
        """Whether the log was imported: of recorded ones the parts are numbered from 1 on."""
        return self.metadata.part == 0

    @property
    def counts(self) -> dict[str, int]:
        """Number of records of each topic that has any."""
        counts = self._contents.counts
        return {topic: counts[channel] for channel, topic in self._topics.items() if counts[channel]}

    def records(
        self, topics: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Entry]:
        """Yield records of these topics (all if None) from ticks at start_ns <= now_ns < end_ns, in recorded order.

        Raises LogError for a topic that no log has, and for damage.
        """
        for now_ns, tick, topic, record in self._decoded(self._decoder.decode, topics, start_ns, end_ns):
            yield Entry(topic, now_ns, tick, record)

    def brief_records(self, topics: Collection[str]) -> Iterator[tuple[int, Record | PlanFigures]]:
        """Time of the tick and record, but of plans the figures alone: for a quick look at a whole log."""
        for now_ns, _, _, record in self._decoded(self._decoder.decode_brief, topics, None, None):
            yield now_ns, record

    def _decoded(
        self,
        decode: Callable[[str, bytes], _R],
        topics: Collection[str] | None,
        start_ns: int | None,
        end_ns: int | None,
    ) -> Iterator[tuple[int, int, str, _R]]:
        """Time of the tick, its number, topic and decoded record."""
        offset = self.metadata.wall_offset_ns
        names = self._topics
        for message in self._messages(topics, start_ns, end_ns):
            topic = names[message.channel_id]
            try:
                record = decode(topic, message.data)
            except OverflowError:
                raise LogError(f"{self.path}: {_NO_TIME}") from None
            except (msgspec.MsgspecError, RecursionError) as error:
                # Its checksum is right, so it was written like this: there is nothing to recover.
                by = self.metadata.version or "another one"
                raise LogError(
                    f"{self.path}: a record of {topic} cannot be read ({error}); read it with the disco-hw that "
                    f"recorded it: {by}"
                ) from None
            yield message.log_time - offset, message.sequence, topic, record

    def columns(
        self, topic: str, start_ns: int | None = None, end_ns: int | None = None
    ) -> dict[str, NDArray[np.generic]]:
        """Return all records of a topic as one array a field, shape (N, ...), as `to_columns` makes them."""
        now_ns: list[int] = []
        records: list[Record] = []
        for entry in self.records((topic,), start_ns, end_ns):
            now_ns.append(entry.now_ns)
            records.append(entry.record)
        return to_columns(TOPIC_BY_NAME[topic].record, now_ns, records)

    def attachment_names(self) -> tuple[str, ...]:
        """Names of the files kept in the log."""
        return tuple(ref.name for ref in self._contents.attachments)

    def attachment(self, name: str) -> bytes:
        """Return the content of a file kept in the log; raises LogError if it is not there or damaged."""
        for ref in self._contents.attachments:
            if ref.name == name:
                try:
                    return read_attachment(self._fd, ref)
                except DamagedError as damage:
                    raise LogError(f"{self.path}: {damage}; {_RECOVER}") from None
        raise LogError(f"{self.path}: holds no {name}; it holds {', '.join(self.attachment_names()) or 'no files'}")

    def summary(self) -> LogSummary:
        """Summarise the log's contents; reads the whole file once. Raises LogError for damage."""
        ticks, missing, breaks, first, last = 0, 0, 0, 0, 0
        for now_ns, lost in self._ticks():
            first = first if ticks else now_ns
            last = now_ns
            ticks += 1
            missing += lost
            breaks += self.is_import and lost > 0
        missing -= breaks
        duration_s = (last - first) * 1e-9
        # A part that continues another holds ticks from before it was begun.
        start_ns = min(self.metadata.start_ns, first) if ticks else self.metadata.start_ns
        ending = self.ending
        offset_ns = end_offset_ns = self.metadata.wall_offset_ns
        if ending is not None and ending.wall_offset_ns is not None:
            end_offset_ns = ending.wall_offset_ns
        if ending is not None:
            missing += max(0, ending.sequence - (self._last_tick or self.metadata.continues_sequence or 0))
        return LogSummary(
            path=str(self.path),
            bytes=self._contents.size,
            complete=self.complete,
            ended=True if ending is not None else False if self.metadata.format >= FORMAT else None,
            end=_iso((last if ending is None else ending.t_ns) + end_offset_ns),
            wall_clock_change_s=(end_offset_ns - offset_ns) * 1e-9,
            continued=ending is not None and ending.continued,
            continues=self.metadata.continues,
            robot=self.metadata.robot,
            version=self.metadata.version,
            part=self.metadata.part,
            start=_iso(start_ns + offset_ns),
            duration_s=duration_s,
            ticks=ticks,
            missing_ticks=missing,
            segment_breaks=breaks,
            topics={
                topic: TopicSummary(count, count / duration_s if duration_s > 0.0 else 0.0)
                for topic, count in self.counts.items()
            },
            attachments={ref.name: ref.data_size for ref in self._contents.attachments},
            damage=self.damage,
        )

    def gaps(self) -> tuple[Gap, ...]:
        """Return the ranges of missing control cycles; reads the whole file once. Raises LogError for damage."""
        return tuple(Gap(now_ns, lost) for now_ns, lost in self._ticks() if lost)

    def _ticks(self) -> Iterator[tuple[int, int]]:
        """Time of each tick and the number of ticks missing just before it."""
        # Ticks are numbered from 1 on, in all parts of a log together.
        previous = 0 if self.metadata.part == 1 else self.metadata.continues_sequence
        any_yet = False
        for message in self._messages(None, None, None):
            if any_yet and message.sequence == previous:
                continue
            lost = 0 if previous is None else (message.sequence - previous - 1) & 0xFFFFFFFF
            yield message.log_time - self.metadata.wall_offset_ns, lost
            previous = self._last_tick = message.sequence
            any_yet = True

    def _messages(self, topics: Collection[str] | None, start_ns: int | None, end_ns: int | None) -> Iterator[Message]:
        unknown = [topic for topic in topics or () if topic not in TOPIC_BY_NAME]
        if unknown:
            raise LogError(f"{unknown[0]}: no such topic; there are {', '.join(TOPIC_BY_NAME)}")
        channels = {channel for channel, topic in self._topics.items() if topics is None or topic in topics}
        offset = self.metadata.wall_offset_ns
        start = None if start_ns is None else start_ns + offset
        end = None if end_ns is None else end_ns + offset
        for chunk in self._contents.chunks:
            if (start is not None and chunk.end_time < start) or (end is not None and chunk.start_time >= end):
                continue
            for message in self._chunk_messages(chunk, channels):
                if not _EARLIEST_NS <= message.log_time - offset <= _LATEST_NS:
                    raise LogError(f"{self.path}: {_NO_TIME}")
                if (start is None or message.log_time >= start) and (end is None or message.log_time < end):
                    yield message

    def _chunk_messages(self, chunk: ChunkRef, channels: Collection[int]) -> Iterator[Message]:
        try:
            yield from messages(read_chunk(self._fd, chunk), channels)
        except DamagedError as damage:
            raise LogError(f"{self.path}: at byte {chunk.offset}: {damage}; {_RECOVER}") from None


def open_log(path: Path) -> Log:
    """Open a log of ours; raises LogError, with one line for the user, if it is none."""
    return Log(path)


@contextlib.contextmanager
def open_parts(path: Path) -> Iterator[list[Log]]:
    """Open a log and the parts beside it that go on with it, in their order; raises LogError as `open_log`.

    All parts of a run have its offset of the clocks, to the nanosecond. A part that cannot be opened is left out.
    """
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(open_log(path))
        parts = []
        for other in path.parent.glob(f"{glob.escape(path.stem)}.part*{glob.escape(path.suffix)}"):
            with contextlib.suppress(LogError, InputError):
                part = stack.enter_context(open_log(other))
                is_later = part.metadata.part > max(first.metadata.part, 1)
                if is_later and part.metadata.wall_offset_ns == first.metadata.wall_offset_ns:
                    parts.append(part)
        yield [first, *sorted(parts, key=lambda part: part.metadata.part)]


def _contents(fd: int, path: Path) -> Contents:
    try:
        return read_contents(fd, str(path))
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read ({error.strerror}); correct its permissions, or give another log"
        ) from None


def _metadata(contents: Contents, path: Path) -> Metadata:
    metadata = _named(contents, METADATA, Metadata)
    if metadata is not None:
        return metadata
    if contents.chunks:
        raise LogError(
            f"{path}: an MCAP file, but not a log of disco-hw; write it as a CSV, which `disco-hw import` takes"
        )
    raise LogError(f"{path}: nothing of the log is left but its first bytes; there is nothing to read")


def _named(contents: Contents, name: str, kind: type[_T]) -> _T | None:
    """Return the first metadata of this name; None if there is none or it is damaged."""
    text = next((record.metadata for record in contents.metadata if record.name == name), None)
    if text is None:
        return None
    try:
        return from_text(text, kind)
    except msgspec.ValidationError:
        return None


def _iso(wall_ns: int) -> str:
    return datetime.fromtimestamp(wall_ns * 1e-9, UTC).isoformat(timespec="milliseconds")
