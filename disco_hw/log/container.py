"""The MCAP container, read so that a cut, damaged or hostile file costs its own bytes and nothing else.

The framing is walked here: every length is checked against the file before a byte of content is taken, so whole
records are found up to where the file breaks off. The content of records is parsed by the mcap library.
(MCAP specification 1.0: magic, then records of opcode u8, length u64, content.)
"""

from __future__ import annotations

import os
import shlex
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, NamedTuple, TypeVar

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.records import Message as McapMessage
from mcap.writer import Writer

from disco_hw.errors import LogError

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_OPCODE = int(Opcode.MESSAGE)
_FOOTER_BYTES = _HEAD.size + 8 + 8 + 4
# Largest offset of a file (int64 of POSIX).
_LARGEST_OFFSET = 2**63 - 1
# Chosen: above any record of a log; a larger one is damage, and would fill the memory.
_LARGEST = 256 * 1024 * 1024
# Of what one tick after the other writes, a chunk shrinks to a tenth; more than this is made to exhaust a reader.
_UNPACKED_FREE = 16 * 1024
_UNPACKED_RATIO = 128
_MOST_DAMAGE = 100
_SEARCH_BYTES = 1024 * 1024
_CHUNK_MARK = b"\x04\x00\x00\x00zstd"
_CHUNK_MARK_AT = _HEAD.size + 8 + 8 + 8 + 4
_FRONT_MATTER = (Opcode.ATTACHMENT, Opcode.METADATA, Opcode.HEADER)
_DATA_SECTION = (*_FRONT_MATTER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX)
_DATA_END_BYTES = 4
_SELF_DELIMITING: dict[int, type[object]] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
}
_DESCRIPTIONS: dict[int, type[object]] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}
_PARSE_ERRORS = (McapError, struct.error, ValueError, KeyError, OverflowError, zstandard.ZstdError)
_T = TypeVar("_T")


class DamagedError(Exception):
    """A record is not what it should be; the message says how."""


class _PackingError(DamagedError):
    """The index is sound, of messages that are packed as in no log of ours; the message says how."""


class Message(NamedTuple):
    """One message of a chunk; times in wall ns."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """Position of a chunk's content in the file, and the log times of its first and last message (wall-clock ns)."""

    offset: int
    length: int
    start_time: int
    end_time: int


@dataclass(slots=True)
class Contents:
    """Contents of an MCAP file: its index of schemas, channels, chunks, attachments and metadata.

    `complete` is False when the index at the end is missing or unusable; then every chunk listed has been checked.
    `damage` says in words what was passed over.
    """

    size: int
    complete: bool = False
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkRef] = field(default_factory=list)
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    damage: list[str] = field(default_factory=list)


def read_contents(fd: int, name: str) -> Contents:
    """Read the index, or without one the whole file.

    Raises LogError if it is no MCAP file at all, or a sound one whose messages are packed in another way.
    """
    size = os.fstat(fd).st_size
    if size == 0:
        raise LogError(f"{name}: empty file; nothing was recorded in it")
    if _read(fd, 0, len(MAGIC)) != MAGIC:
        raise LogError(f"{name}: not an MCAP file; give a log that disco-hw has recorded")
    try:
        return _indexed(fd, size)
    except DamagedError as damage:
        contents, ended = _walked(fd, size)
        if isinstance(damage, _PackingError) and not contents.chunks:
            raise LogError(
                f"{name}: {damage}, which disco-hw does not read; pack it anew: `mcap compress {shlex.quote(name)} "
                "-o NEW.mcap`"
            ) from None
        if ended:
            contents.damage.append(f"the index at the end is unusable: {damage}")
        return contents


def read_profile(fd: int) -> str:
    """Return the profile in the header of an MCAP file, "ros2" for a bag; empty where the header is damaged."""
    try:
        opcode, length = _HEAD.unpack(_content(fd, len(MAGIC), _HEAD.size))
        return _parse(Header, _content(fd, len(MAGIC) + _HEAD.size, length)).profile if opcode == Opcode.HEADER else ""
    except DamagedError:
        return ""


def _walked(fd: int, size: int) -> tuple[Contents, bool]:
    """Contents from walking the file, with every chunk checked, and whether its data came to their end.

    After damage it goes on with the next whole chunk.
    """
    contents = Contents(size=size)
    offset, unlisted, ended = len(MAGIC), 0, False
    before = offset
    while offset < size and not ended:
        head = _read(fd, offset, _HEAD.size)
        opcode, length = _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)
        follows = offset + _HEAD.size + length
        ended = opcode == Opcode.DATA_END and length == _DATA_END_BYTES
        try:
            if opcode not in _DATA_SECTION and not ended:
                raise DamagedError("no record")
            if follows > size and not ended:
                raise DamagedError("an unfinished record")
            _index_record(fd, contents, opcode, offset, length)
        except DamagedError as damage:
            place = offset
            if opcode not in _FRONT_MATTER or not _is_followed(fd, follows, size):
                # Of a damaged chunk the length is in doubt as well, and where no record is, that of the one before.
                follows = _next_chunk(fd, (offset if opcode in _DATA_SECTION else before) + 1, size) or size
                place = offset if follows > offset else before
            if len(contents.damage) < _MOST_DAMAGE:
                contents.damage.append(f"at byte {place}: {damage}; {follows - place} bytes are lost")
            else:
                unlisted += 1
        before, offset = offset, follows
    if unlisted:
        contents.damage.append(f"at {unlisted} further places something is lost")
    if not ended:
        contents.damage.append("the end is missing: the writer was killed or is still at work, or the file was cut")
    return contents, ended


def _is_followed(fd: int, offset: int, size: int) -> bool:
    """Return whether a record, or the end of the file, is at this place."""
    head = _read(fd, offset, _HEAD.size)
    if len(head) < _HEAD.size:
        return offset == size
    opcode, length = _HEAD.unpack(head)
    return opcode in (*_DATA_SECTION, Opcode.DATA_END) and offset + _HEAD.size + length <= size


def _next_chunk(fd: int, start: int, size: int) -> int | None:
    """Return where the next chunk record seems to begin at or after `start`, found by the name of its compression."""
    at = start + _CHUNK_MARK_AT
    while at < size:
        try:
            # What a sparse file does not have need not be searched.
            at = max(at, os.lseek(fd, at, os.SEEK_DATA))
        except OSError:
            return None
        block = _read(fd, at, _SEARCH_BYTES)
        found = block.find(_CHUNK_MARK)
        while found >= 0:
            candidate = at + found - _CHUNK_MARK_AT
            if _read(fd, candidate, 1) == bytes([Opcode.CHUNK]):
                return candidate
            found = block.find(_CHUNK_MARK, found + 1)
        at += _SEARCH_BYTES - len(_CHUNK_MARK) + 1
    return None


def read_chunk(fd: int, chunk: ChunkRef) -> bytes:
    """Return the records inside a chunk, checked against its CRC; raises DamagedError."""
    record = _parse(Chunk, _content(fd, chunk.offset, chunk.length))
    if record.uncompressed_size > min(_LARGEST, _UNPACKED_FREE + _UNPACKED_RATIO * len(record.data)):
        raise DamagedError(f"a chunk that claims to be {record.uncompressed_size} bytes, packed in {len(record.data)}")
    try:
        data = _decompress(record)
    except _PARSE_ERRORS as error:
        raise DamagedError(f"a chunk that cannot be decompressed ({error})") from None
    if len(data) != record.uncompressed_size:
        raise DamagedError("a chunk of the wrong size")
    if record.uncompressed_crc and zlib.crc32(data) != record.uncompressed_crc:
        raise DamagedError("a chunk with a wrong checksum")
    return data


def read_attachment(fd: int, index: AttachmentIndex) -> bytes:
    """Return the bytes of an attachment, checked against its CRC; raises DamagedError."""
    return bytes(_attachment(fd, index.offset, index.length - _HEAD.size).data)


def _attachment(fd: int, offset: int, length: int) -> Attachment:
    content = _content(fd, offset + _HEAD.size, length)
    record = _parse(Attachment, content)
    crc = int.from_bytes(content[-4:], "little")
    if crc and zlib.crc32(content[:-4]) != crc:
        raise DamagedError(f"the attachment {record.name} has a wrong checksum")
    return record


def messages(chunk_data: bytes, channels: Collection[int] | None = None) -> Iterator[Message]:
    """Yield the messages in a chunk's data, of the wanted channels or of all, in file order; raises DamagedError."""
    # Runs for every message of a log, so its head and its content's head are unpacked at once.
    offset, size, header = 0, len(chunk_data), _MESSAGE.size
    unpack = _MESSAGE.unpack_from
    while size - offset >= header:
        opcode, length, channel_id, sequence, log_time, publish_time = unpack(chunk_data, offset)
        begin, offset = offset, offset + _HEAD.size + length
        if offset > size:
            raise DamagedError("a record that reaches beyond its chunk")
        if opcode != _MESSAGE_OPCODE:
            continue
        if offset - begin < header:
            raise DamagedError("a message that is too short")
        if channels is None or channel_id in channels:
            yield Message(channel_id, sequence, log_time, publish_time, chunk_data[begin + header : offset])
    # What is left is too short for a message.
    for opcode, _, _ in _inner(chunk_data, offset):
        if opcode == _MESSAGE_OPCODE:
            raise DamagedError("a message that is too short")


class McapCopy:
    """Copies the schemas, channels and messages of one MCAP file to a new one; a channel without schema keeps none."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[int, int] = {}
        self._channels: dict[int, int] = {}

    def describe(self, record: Schema | Channel) -> None:
        """Copy a schema or channel, of several with one number the first; schemas come before their channels."""
        if isinstance(record, Schema):
            if record.id not in self._schemas:
                self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif record.id not in self._channels:
            schema = self._schemas.get(record.schema_id, 0)
            self._channels[record.id] = self._writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )

    def add(self, message: Message | McapMessage) -> bool:
        """Copy a message; False for one of a channel that nothing describes."""
        channel = self._channels.get(message.channel_id)
        if channel is None:
            return False
        self._writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        return True


def _inner(data: bytes, offset: int = 0) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and end of the content of each record from `offset` on."""
    size = len(data)
    while offset < size:
        if size - offset < _HEAD.size:
            raise DamagedError("a record that is cut off")
        opcode, length = _HEAD.unpack_from(data, offset)
        start = offset + _HEAD.size
        if length > size - start:
            raise DamagedError("a record that reaches beyond its chunk")
        offset = start + length
        yield opcode, start, offset


def _records(data: bytes) -> Iterator[object]:
    """Yield what a chunk or an index says of the log, as the library parses it; raises DamagedError."""
    for opcode, start, end in _inner(data):
        kind = _DESCRIPTIONS.get(opcode)
        if kind is not None:
            yield _parse(kind, data[start:end])


def _indexed(fd: int, size: int) -> Contents:
    """Contents from the index at the end of a complete file; raises DamagedError if there is none to rely on."""
    tail = _read(fd, max(0, size - _FOOTER_BYTES - len(MAGIC)), _FOOTER_BYTES + len(MAGIC))
    if len(tail) < _FOOTER_BYTES + len(MAGIC) or tail[-len(MAGIC) :] != MAGIC:
        raise DamagedError("no end mark")
    opcode, length = _HEAD.unpack_from(tail)
    footer_at = size - _FOOTER_BYTES - len(MAGIC)
    if opcode != Opcode.FOOTER or length != _FOOTER_BYTES - _HEAD.size:
        raise DamagedError("no footer")
    footer = _parse(Footer, tail[_HEAD.size : -len(MAGIC)])
    if not len(MAGIC) <= footer.summary_start <= footer_at:
        raise DamagedError("no index")
    summary = _content(fd, footer.summary_start, footer_at - footer.summary_start)
    if footer.summary_crc and zlib.crc32(summary + tail[: _FOOTER_BYTES - 4]) != footer.summary_crc:
        raise DamagedError("an index with a wrong checksum")
    contents = Contents(size=size, complete=True)
    has_counts, compressions = False, set[str]()
    for record in _records(summary):
        match record:
            case Schema():
                contents.schemas[record.id] = record
            case Channel():
                contents.channels[record.id] = record
            case Statistics():
                contents.counts.update(record.channel_message_counts)
                has_counts = True
            case ChunkIndex():
                compressions.add(record.compression)
                offset, length = record.chunk_start_offset + _HEAD.size, record.chunk_length - _HEAD.size
                contents.chunks.append(ChunkRef(offset, length, record.message_start_time, record.message_end_time))
            case AttachmentIndex():
                contents.attachments.append(record)
            case MetadataIndex():
                content = _content(fd, record.offset + _HEAD.size, record.length - _HEAD.size)
                contents.metadata.append(_parse(Metadata, content))
    _refuse_useless_index(contents, has_counts, compressions)
    return contents


def _refuse_useless_index(contents: Contents, has_counts: bool, compressions: set[str]) -> None:
    """Raise DamagedError for an index that leads to no messages."""
    if "lz4" in compressions:
        raise _PackingError("its chunks are packed with lz4")
    if contents.counts.total() and not contents.chunks:
        raise _PackingError("its messages are not in chunks")
    if not has_counts or not contents.chunks:
        raise DamagedError("an index without chunks")


def _index_record(fd: int, contents: Contents, opcode: int, offset: int, length: int) -> None:
    """Note the top-level record at `offset`, whose content has this length; raises DamagedError."""
    if opcode in _DATA_SECTION and length != _length_within(fd, opcode, offset + _HEAD.size, length):
        raise DamagedError("a record of a wrong length")
    if opcode == Opcode.CHUNK:
        _index_chunk(fd, contents, offset + _HEAD.size, length)
    elif opcode == Opcode.ATTACHMENT:
        kept = _attachment(fd, offset, length)
        contents.attachments.append(
            AttachmentIndex(
                offset, length + _HEAD.size, kept.log_time, kept.create_time, len(kept.data), kept.name, kept.media_type
            )
        )
    elif opcode == Opcode.METADATA:
        contents.metadata.append(_parse(Metadata, _content(fd, offset + _HEAD.size, length)))


def _length_within(fd: int, opcode: int, offset: int, length: int) -> int:
    """Return the length of a record's content by what is in it, where that says one."""
    if opcode == Opcode.MESSAGE_INDEX:
        return 6 + int.from_bytes(_read(fd, offset + 2, 4), "little")
    if opcode == Opcode.CHUNK:
        name = int.from_bytes(_read(fd, offset + 28, 4), "little")
        return 40 + name + int.from_bytes(_read(fd, offset + 32 + name, 8), "little")
    kind = _SELF_DELIMITING.get(opcode)
    if kind is None:
        return length
    content = BytesIO(_content(fd, offset, length))
    _parse(kind, content)
    return content.tell()


def _index_chunk(fd: int, contents: Contents, offset: int, length: int) -> None:
    data = read_chunk(fd, ChunkRef(offset, length, 0, 0))
    records = list(_records(data))
    heads = [(message.channel_id, message.log_time) for message in messages(data)]
    first, last = (heads[0][1], heads[-1][1]) if heads else (0, 0)
    contents.schemas.update({record.id: record for record in records if isinstance(record, Schema)})
    contents.channels.update({record.id: record for record in records if isinstance(record, Channel)})
    contents.counts.update(channel_id for channel_id, _ in heads)
    contents.chunks.append(ChunkRef(offset, length, first, last))


def _decompress(record: Chunk) -> bytes:
    if record.compression == "zstd":
        size = zstandard.frame_content_size(record.data)
        if size not in (-1, record.uncompressed_size):
            raise DamagedError("a chunk of the wrong size")
        return zstandard.decompress(record.data, max_output_size=max(1, record.uncompressed_size))
    if record.compression == "":
        return bytes(record.data)
    raise DamagedError(f"a chunk compressed with {record.compression!r}, which is not known here")


def _content(fd: int, offset: int, length: int) -> bytes:
    if not 0 <= length <= _LARGEST:
        raise DamagedError(f"a record of {length} bytes")
    data = _read(fd, offset, length)
    if len(data) != length:
        raise DamagedError("a record that reaches beyond the file")
    return data


def _read(fd: int, offset: int, length: int) -> bytes:
    """Up to `length` bytes; fewer only at the end of the file."""
    parts = []
    while length > 0:
        part = os.pread(fd, length, offset) if offset <= _LARGEST_OFFSET else b""
        if not part:
            break
        parts.append(part)
        offset += len(part)
        length -= len(part)
    return b"".join(parts)


def _parse(record: type[_T], content: bytes | BytesIO) -> _T:
    read: Callable[[Any], _T] = record.read  # type: ignore[attr-defined]
    try:
        return read(ReadDataStream(content if isinstance(content, BytesIO) else BytesIO(content)))
    except _PARSE_ERRORS as error:
        raise DamagedError(f"a {record.__name__.lower()} record that cannot be read ({error})") from None
