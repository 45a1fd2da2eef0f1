"""Copies everything whole from a damaged log into a new, complete one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from mcap.writer import CompressionType, Writer

from disco_hw.errors import LogError
from disco_hw.files import LOG, open_file
from disco_hw.log.container import Contents, DamagedError, messages, read_attachment, read_chunk, read_contents
from disco_hw.log.mcap_log import CHUNK_BYTES, LIBRARY, PROFILE, RECOVERY


@dataclass(frozen=True, slots=True)
class Recovered:
    """What a recovery has brought over, and in words what was lost."""

    messages: int
    chunks: int
    attachments: int
    lost: tuple[str, ...]


def recover(source: Path, target: Path) -> Recovered:
    """Copy all complete chunks, attachments and metadata; the source stays as it is.

    Works on any MCAP file with zstd or no compression. Raises LogError if the source is no MCAP file or has no message
    that can be read, or the target exists or cannot be written; a half-written target is removed.
    """
    fd = open_file(source, LOG)
    try:
        contents = read_contents(fd, str(source))
        try:
            stream = target.open("xb")
        except FileExistsError:
            raise LogError(f"{target}: already exists; give another name") from None
        try:
            with stream:
                writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
                recovered = _copy(fd, contents, writer, source.name)
            if not recovered.messages:
                raise LogError(f"{source}: no message in it can be read; there is nothing to recover")
        except BaseException:
            target.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise LogError(f"{source} -> {target}: {error.strerror}; give a place that can be written to") from None
    finally:
        os.close(fd)
    return recovered


def _copy(fd: int, contents: Contents, writer: Writer, name: str) -> Recovered:
    lost = list(contents.damage)
    writer.start(profile=PROFILE, library=LIBRARY)
    for metadata in contents.metadata:
        writer.add_metadata(metadata.name, metadata.metadata)
    attachments = 0
    for ref in contents.attachments:
        try:
            writer.add_attachment(ref.log_time, ref.log_time, ref.name, ref.media_type, read_attachment(fd, ref))
            attachments += 1
        except DamagedError as damage:
            lost.append(str(damage))
    schemas = {
        schema.id: writer.register_schema(schema.name, schema.encoding, schema.data)
        for schema in contents.schemas.values()
    }
    channels = {
        channel.id: writer.register_channel(
            channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0), channel.metadata
        )
        for channel in contents.channels.values()
    }
    count, chunks = 0, 0
    for chunk in contents.chunks:
        try:
            found = list(messages(read_chunk(fd, chunk)))
        except DamagedError as damage:
            lost.append(f"at byte {chunk.offset}: {damage}; {chunk.length} bytes are lost")
            continue
        chunks += 1
        for message in found:
            if message.channel_id in channels:
                writer.add_message(
                    channels[message.channel_id],
                    message.log_time,
                    message.data,
                    message.publish_time,
                    message.sequence,
                )
                count += 1
    writer.add_metadata(RECOVERY, {"source": name, "lost": "\n".join(lost)})
    writer.finish()  # type: ignore[no-untyped-call]
    return Recovered(count, chunks, attachments, tuple(lost))
