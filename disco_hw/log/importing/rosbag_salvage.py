"""What is whole of a damaged bag -> a new file that `rosbags` can read.

A recording that ended in a power cut has no index, and a last chunk that is not whole. Its records are read one after
the other until the damage, and from an MCAP also after a chunk that does not match its checksum.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

_LARGEST_RECORD_BYTES = 256 * 1024 * 1024
_LARGEST_MESSAGE_BYTES = 1024 * 1024
"""Images and clouds are left behind: nothing that is imported is as large."""
_LARGEST_UNPACKED_BYTES = 512 * 1024 * 1024
_QUERY_BATCH = 1000


def salvage(path: Path, folder: Path) -> tuple[Path, str] | None:
    """Copy what is whole of a bag's file into a new file in `folder`.

    Returns the new file and a sentence on what is missing, or None where nothing could be read or nobody knows how.
    """
    copy: Callable[[Path, Path], str] | None = {".mcap": _copy_mcap, ".db3": _copy_sqlite}.get(path.suffix)
    if copy is None:
        return None
    target = folder / path.name
    try:
        said = copy(path, target)
    except Exception:  # Foreign bytes in the hands of three libraries; whoever opened the bag says what is wrong.
        return None
    return (target, said) if said else None


def _copy_mcap(path: Path, target: Path) -> str:
    """Copy the messages of an MCAP; returns how far it could be read, empty if there is no message."""
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    messages = damaged = 0
    size = path.stat().st_size
    with path.open("rb") as source, target.open("wb") as sink:
        writer = Writer(sink, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        # Where the damage begins nothing can be read any more.
        with contextlib.suppress(Exception):
            for record in _records(source):
                if record is None:
                    damaged += 1
                elif isinstance(record, Schema) and record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
                elif isinstance(record, Channel) and record.id not in channels:
                    schema = schemas.get(record.schema_id, 0)
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schema, record.metadata
                    )
                elif isinstance(record, Message) and record.channel_id in channels:
                    messages += 1
                    if len(record.data) <= _LARGEST_MESSAGE_BYTES:
                        writer.add_message(
                            channels[record.channel_id], record.log_time, record.data, record.publish_time
                        )
        read = source.tell()
        writer.finish()
    chunks = f", {damaged} damaged chunks were left out" if damaged else ""
    return (
        f"{messages} messages were read from {100.0 * read / max(size, 1):.0f} % of the file{chunks}"
        if messages
        else ""
    )


def _records(source: Any) -> Iterator[Any]:  # Any: a binary file; the library's records, None for a damaged chunk.
    reader = StreamReader(source, emit_chunks=True, record_size_limit=_LARGEST_RECORD_BYTES)
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
        elif record.uncompressed_size <= _LARGEST_UNPACKED_BYTES:
            try:
                inside = breakup_chunk(record, validate_crc=True)
            except Exception:  # Whatever the decompressors raise of damaged bytes: counted, and said.
                yield None
                continue
            yield from inside
        else:
            yield None


def _copy_sqlite(path: Path, target: Path) -> str:
    """Copy the rows of a sqlite3 file until the damage; returns how many, empty if there is no message."""
    messages = 0
    with (
        contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as source,
        contextlib.closing(sqlite3.connect(target)) as sink,
    ):
        tables = source.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite_%'")
        for name, creation in tables.fetchall():
            sink.execute(creation)
            with contextlib.suppress(sqlite3.DatabaseError):
                for row in _rows(source, name):
                    sink.execute(f'INSERT INTO "{name}" VALUES ({", ".join("?" * len(row))})', row)
                    messages += name == "messages"
        sink.commit()
    return f"{messages} messages were read up to the damage" if messages else ""


def _rows(source: sqlite3.Connection, table: str) -> Iterator[tuple[Any, ...]]:  # Any: whatever sqlite holds.
    """Rows in the order in which they were written; an index, which needs the whole file, is not used."""
    found = source.execute(f'SELECT * FROM "{table}" NOT INDEXED')
    while rows := found.fetchmany(_QUERY_BATCH):
        yield from rows
