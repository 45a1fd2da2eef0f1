"""What recorder and writer say to each other: the start file, the batches, the status lines.

The start file goes ahead on disk, so that a writer started anew knows what the file begins with. Batches go over a
local ZeroMQ socket, one message for each tick. Status lines come back over the writer's standard output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import msgspec

from disco_hw.log.records import TOPIC_INDEX, TOPICS, Record

END = b""
"""The message after which no batch follows."""

EXIT_CANNOT_CREATE = 73
EXIT_CANNOT_WRITE = 74

ENCODE_ERRORS = (TypeError, ValueError, OverflowError, KeyError)
"""What encoding raises for something that is not a record, or a record with content that it cannot have."""


class Attachment(msgspec.Struct, frozen=True):
    """A file kept inside the log."""

    name: str
    media_type: str
    data: bytes


class Start(msgspec.Struct, frozen=True):
    """Everything a writer must know; wall-clock time is monotonic time plus `wall_offset_ns` throughout the log."""

    path: str
    endpoint: str
    robot: str
    version: str
    part: int
    parent_pid: int
    start_ns: int
    wall_offset_ns: int
    attachments: tuple[Attachment, ...] = ()
    flush_s: float = 0.5
    silence_s: float = 10.0
    grace_s: float = 3.0


class WriterStatus(msgspec.Struct, frozen=True):
    """How the writer is doing: totals since its start, and the error that ended it, if any."""

    state: Literal["recording", "finished", "failed"]
    records: int
    refused: int
    bytes: int
    error: str = ""


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """The records of one tick: its number since the recorder was made, its time, and (topic index, record) pairs."""

    sequence: int
    now_ns: int
    records: tuple[tuple[int, msgspec.Raw], ...]


def batch_encoder() -> Callable[[int, int, Sequence[Record]], bytes]:
    """A function (sequence, now_ns, records) -> message; it raises one of ENCODE_ERRORS."""
    encode = msgspec.msgpack.Encoder(enc_hook=_from_numpy).encode
    index = TOPIC_INDEX

    def encode_batch(sequence: int, now_ns: int, records: Sequence[Record]) -> bytes:
        return encode((sequence, now_ns, [(index[type(record)], record) for record in records]))

    return encode_batch


def _from_numpy(value: Any) -> Any:
    """Take numpy scalars and arrays (flattened, row-major) where plain numbers and tuples are meant."""
    if hasattr(value, "tolist"):
        plain = value.ravel().tolist() if getattr(value, "ndim", 0) else value.tolist()
        if plain is not value:
            return plain
    raise TypeError(f"{type(value).__name__} cannot be recorded")


class BatchDecoder:
    """Decodes messages to batches and their records; raises msgspec.MsgspecError on what is neither."""

    def __init__(self) -> None:
        self._batch = msgspec.msgpack.Decoder(Batch)
        self._records = tuple(msgspec.msgpack.Decoder(topic.record) for topic in TOPICS)

    def batch(self, message: bytes) -> Batch:
        """The batch of one message, its records still encoded."""
        return self._batch.decode(message)

    def record(self, topic_index: int, data: msgspec.Raw) -> Record:
        """One record of a batch."""
        if not 0 <= topic_index < len(self._records):
            raise msgspec.ValidationError(f"there is no topic {topic_index}")
        return self._records[topic_index].decode(data)
