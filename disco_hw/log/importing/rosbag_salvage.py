"""Salvage of a damaged bag: all that can be read is copied to a new file that `rosbags` can read.

A recording that ended in a power cut has no index, and a last chunk that is not whole. Its records are read one after
the other until the damage, and also after a chunk that does not match its checksum or cannot be unpacked.
"""

from __future__ import annotations

import bz2
import contextlib
import os
import sqlite3
import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from disco_hw.files import LOG, open_file
from disco_hw.log.container import McapCopy

# Chosen: as of our own logs (`disco_hw.log.container`): a larger record is damage.
_LARGEST_RECORD_BYTES = 256 * 1024 * 1024
_LARGEST_MESSAGE_BYTES = 1024 * 1024
"""Images and clouds are left behind: nothing that is imported is as large."""
# Chosen: a chunk that claims more is damage, and would fill the memory.
_LARGEST_UNPACKED_BYTES = 512 * 1024 * 1024


def salvage(path: Path, folder: Path) -> tuple[Path, str] | None:
    """Copy what is whole of a bag's file into a new file in `folder`.

    Returns the new file and a sentence on what is missing, or None where nothing could be read or nobody knows how.
    """
    copy = _COPIES.get(path.suffix)
    if copy is None:
        return None
    target = folder / path.name
    try:
        damage = copy(path, target)
    except Exception:  # Foreign bytes in the hands of three libraries; whoever opened the bag says what is wrong.
        return None
    return (target, damage) if damage else None


def _copy_mcap(path: Path, target: Path) -> str:
    """Copy the messages of an MCAP; returns how much could be read, empty if there is no message."""
    messages = damaged = 0
    with os.fdopen(open_file(path, LOG), "rb") as source, target.open("wb") as sink:
        writer = Writer(sink, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        copy = McapCopy(writer)
        # Where the damage begins nothing can be read any more.
        with contextlib.suppress(Exception):
            for record in _records(source):
                match record:
                    case None:
                        damaged += 1
                    case Schema() | Channel():
                        copy.describe(record)
                    case Message():
                        messages += len(record.data) > _LARGEST_MESSAGE_BYTES or copy.add(record)
        writer.finish()  # type: ignore[no-untyped-call]  # The library does not annotate it.
    return _extent(messages, damaged)


def _extent(messages: int, damaged: int = 0) -> str:
    """Say how much of a file was read; empty if there is no message."""
    chunks = f", {damaged} damaged chunks were left out" if damaged else ""
    return f"{messages} messages could be read{chunks}" if messages else ""


def _records(source: BinaryIO) -> Iterator[Any]:  # Any: the library's records, None for a damaged chunk.
    reader = StreamReader(source, emit_chunks=True, record_size_limit=_LARGEST_RECORD_BYTES)
    readable = 0
    with contextlib.suppress(Exception):
        for record in reader.records:
            readable = source.tell()
            if not isinstance(record, Chunk):
                yield record
                continue
            inside: list[Any] = [None]
            # Whatever the decompressors raise of damaged bytes: counted, and said.
            with contextlib.suppress(Exception):
                if record.uncompressed_size <= _LARGEST_UNPACKED_BYTES:
                    inside = breakup_chunk(record, validate_crc=True)
            yield from inside
    source.seek(readable)
    rest = source.read(_LARGEST_RECORD_BYTES)
    # What is whole of a last chunk that was cut: a short recording may have no other.
    if rest[:1] == _MCAP_CHUNK:
        yield from StreamReader(BytesIO(_cut_chunk(rest)), skip_magic=True).records


_MCAP_CHUNK = b"\x06"
_BEFORE_COMPRESSION = struct.calcsize("<BQQQQI")
"""Bytes before a chunk's compression: kind and length of the record, first and last time, unpacked size, checksum."""


def _cut_chunk(record: bytes) -> bytes:
    """Unpack the beginning of an MCAP chunk as far as it is there."""
    (length,) = struct.unpack_from("<I", record, _BEFORE_COMPRESSION)
    begin = _BEFORE_COMPRESSION + 4 + length
    compression = record[begin - length : begin]
    data = record[begin + 8 :]
    return _unpacked(compression or b"none", data)


def _copy_sqlite(path: Path, target: Path) -> str:
    """Copy the rows of a sqlite3 file until the damage; returns how many, empty if there is no message."""
    messages = 0
    with (
        contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as source,
        contextlib.closing(sqlite3.connect(target)) as sink,
    ):
        # Without this a file that is shorter than its first page says is refused as a whole.
        source.execute("PRAGMA writable_schema = ON")
        tables = source.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
        for name, creation in tables.fetchall():
            sink.execute(creation)
            with contextlib.suppress(sqlite3.DatabaseError):
                for row in _rows(source, name):
                    sink.execute(f'INSERT INTO "{name}" VALUES ({", ".join("?" * len(row))})', row)
                    messages += name == "messages"
        sink.commit()
    return _extent(messages)


def _rows(source: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:  # Any: whatever sqlite holds.
    """Rows in the order in which they were written; an index, which needs the whole file, is not used."""
    # Row by row: of a batch that meets the damage nothing would be left.
    yield from source.execute(f'SELECT * FROM "{table}" NOT INDEXED')


_MESSAGE, _CHUNK, _CONNECTION = b"\x02", b"\x05", b"\x07"
"""Kinds (op) of the records of a bag of ROS 1."""
Record = tuple[dict[str, bytes], bytes]


def _copy_ros1(path: Path, target: Path) -> str:
    """Copy the messages of a bag of ROS 1; returns how much could be read, empty if there is no message."""
    from rosbags.rosbag1 import Writer as BagWriter  # noqa: PLC0415

    connections: dict[bytes, Any] = {}
    messages = damaged = 0
    with os.fdopen(open_file(path, LOG), "rb") as source, BagWriter(target) as writer:
        source.readline()
        with contextlib.suppress(Exception):
            for record in _ros1_records(source):
                if record is None:
                    damaged += 1
                    continue
                header, data = record
                if header["op"] == _CONNECTION and header["conn"] not in connections:
                    fields = _ros1_fields(data)
                    connections[header["conn"]] = writer.add_connection(
                        header["topic"].decode(),
                        fields["type"].decode().replace("/", "/msg/"),
                        msgdef=fields["message_definition"].decode(),
                        md5sum=fields["md5sum"].decode(),
                        # Two publishers of one topic are two connections.
                        callerid=str(len(connections)),
                    )
                elif header["op"] == _MESSAGE and header["conn"] in connections:
                    messages += 1
                    if len(data) <= _LARGEST_MESSAGE_BYTES:
                        s, ns = struct.unpack("<II", header["time"])
                        writer.write(connections[header["conn"]], s * 1_000_000_000 + ns, data)
    return _extent(messages, damaged)


def _ros1_records(source: BinaryIO) -> Iterator[Record | None]:
    """Yield header and data of each whole record, those in chunks as well; None for a chunk that cannot be unpacked."""
    while size := source.read(4):
        header = _ros1_fields(source.read(*struct.unpack("<I", size)))
        (length,) = struct.unpack("<I", source.read(4))
        if length > _LARGEST_RECORD_BYTES:
            raise ValueError("record too large")
        data = source.read(length)
        is_chunk = header["op"] == _CHUNK
        # What is whole of a chunk that was cut can be read if it is not compressed.
        if len(data) < length and not (is_chunk and header["compression"] == b"none"):
            return
        if not is_chunk:
            yield header, data
            continue
        try:
            yield from _ros1_records(BytesIO(_unpacked(header["compression"], data)))
        except Exception:  # Whatever the decompressors raise of damaged bytes: counted, and said.
            yield None


def _ros1_fields(block: bytes) -> dict[str, bytes]:
    """Return the fields of a header, by name: each a length (4 bytes) and name=value."""
    fields, at = {}, 0
    while at < len(block):
        (length,) = struct.unpack_from("<I", block, at)
        name, _, value = block[at + 4 : at + 4 + length].partition(b"=")
        fields[name.decode()] = value
        at += 4 + length
    return fields


def _unpacked(compression: bytes, data: bytes) -> bytes:
    """Unpack packed bytes of which the end may be missing."""
    if compression == b"none":
        return data
    if compression == b"bz2":
        return bz2.BZ2Decompressor().decompress(data, _LARGEST_UNPACKED_BYTES)
    if compression == b"zstd":
        from zstandard import ZstdDecompressor  # noqa: PLC0415

        return bytes(ZstdDecompressor().stream_reader(data).read(_LARGEST_UNPACKED_BYTES))
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # noqa: PLC0415

    return bytes(LZ4FrameDecompressor().decompress(data, _LARGEST_UNPACKED_BYTES))


_COPIES: dict[str, Callable[[Path, Path], str]] = {".mcap": _copy_mcap, ".db3": _copy_sqlite, ".bag": _copy_ros1}
"""How a file is copied as far as it is whole, by how its name ends."""
