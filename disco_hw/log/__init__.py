"""Recording and reading of logs: what is recorded, how it gets to the disk without disturbing the loop, how it is read.

Here what every log begins with (`Start`), and what recorder, keeper and writer say to each other. The recorder hands
records to the writer over a stream socket, one frame a tick, and the writer answers on the same socket with how far it
has come: a tick is delivered when it is in the file, not when it was sent. The keeper, on another socket, starts
writers, which inherit the start.
"""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from disco_hw.files import FileKind, read_bytes
from disco_hw.log.records import TOPIC_INDEX, TOPICS, Record

ENCODE_ERRORS = (TypeError, ValueError, OverflowError, KeyError)
"""What encoding raises for something that is not a record, or a record with content that it cannot have."""

TICK, END, STATES_IN_FORCE = 0, 1, 2
"""Kinds of frames to the writer: a `Batch`, the `End` after which none follows, and a `Batch` for the next tick's."""
# Chosen: above any message to or from the keeper and any status of a writer, whose longest parts are paths.
MESSAGE_BYTES = 65_536

_HEAD = struct.Struct(">BI")


class Attachment(msgspec.Struct, frozen=True):
    """A file kept inside the log."""

    name: str
    media_type: str
    data: bytes


class TaskScene(msgspec.Struct, frozen=True):
    """Static content that a viewer draws beside the records, in metres: the task's line, the fence, and the robot.

    `footprint_m`: its outline in the robot's own frame.
    """

    outline_m: tuple[tuple[float, float], ...]
    axial_distance_m: float
    wheel_radius_m: float
    fence_m: tuple[tuple[tuple[float, float], ...], ...] = ()
    footprint_m: tuple[tuple[float, float], ...] = ()


class Start(msgspec.Struct, frozen=True):
    """Start of a log, all that a writer must know; wall-clock time is monotonic time plus `wall_offset_ns`.

    `path` is the first part's. A later part names the file that it continues, of which it is known that ticks up to
    `continues_sequence` are in it. It is also the request to the keeper process to start a writer on the attached
    socket, then without attachments and scene, which the keeper has.
    """

    path: str
    robot: str
    version: str
    start_ns: int
    wall_offset_ns: int
    part: int = 1
    continues: str = ""
    continues_sequence: int | None = None
    attachments: tuple[Attachment, ...] = ()
    scene: TaskScene | None = None
    flush_s: float = 0.5
    beat_s: float = 0.2
    grace_s: float = 3.0
    planner: int = 0
    angle_measured: bool = True
    speed_measured: bool = True


class Started(msgspec.Struct, frozen=True, tag=True):
    """Report of the keeper process: process id of the newest writer, or 0 if none could be made, as its status says."""

    pid: int


class Ended(msgspec.Struct, frozen=True, tag=True):
    """Report of the keeper process: exit code of a writer, negative for a signal."""

    pid: int
    code: int


Time64 = Annotated[int, msgspec.Meta(ge=-(2**63) + 1, le=2**63 - 1)]
"""A time or an offset of times, ns, in the 64 bits that a log has for it."""


class End(msgspec.Struct, frozen=True, omit_defaults=True):
    """The recorder's last word: when it ended (monotonic), the last tick's number, and how many ticks it dropped.

    `continued`: the file is full, and the recorder goes on in another part. `wall_offset_ns`: wall-clock time minus
    monotonic time then, None if that was not recorded.
    """

    t_ns: Time64
    sequence: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    dropped_ticks: int
    continued: bool = False
    wall_offset_ns: Time64 | None = None


class WriterStatus(msgspec.Struct, frozen=True):
    """State of the log writer: what is in its file, and the error that ended it, if any.

    All ticks up to number `sequence` that were sent are in the file, apart from `refused` records. `deleted`: the file
    was removed, and all that was in it with it. `sync_s`: how long the disk has been at work on what is in the file.
    """

    state: Literal["recording", "finished", "failed"]
    path: str
    part: int
    sequence: int = 0
    records: int = 0
    refused: int = 0
    bytes: int = 0
    error: str = ""
    deleted: bool = False
    sync_s: float = 0.0


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """The records of one tick: its number since the recorder was made, its time, and (topic index, record) pairs."""

    sequence: int
    now_ns: int
    records: tuple[tuple[int, msgspec.Raw], ...]


def frame(kind: int, payload: bytes) -> bytes:
    """One frame of the stream to the writer."""
    return _HEAD.pack(kind, len(payload)) + payload


class Frames:
    """Takes a stream apart into frames again."""

    def __init__(self) -> None:
        self._received = bytearray()

    def add(self, data: bytes) -> None:
        """Take in what came."""
        self._received += data

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Kind and payload of each frame that is whole; what is not stays."""
        offset = 0
        try:
            while len(self._received) - offset >= _HEAD.size:
                kind, length = _HEAD.unpack_from(self._received, offset)
                end = offset + _HEAD.size + length
                if end > len(self._received):
                    return
                payload = bytes(memoryview(self._received)[offset + _HEAD.size : end])
                offset = end
                yield kind, payload
        finally:
            del self._received[:offset]


def batch_encoder() -> Callable[[int, int, Sequence[Record]], bytes]:
    """Return a function (sequence, now_ns, records) -> message; it raises one of ENCODE_ERRORS."""
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
        """Return the batch of one message, its records still encoded."""
        return self._batch.decode(message)

    def record(self, topic_index: int, data: msgspec.Raw) -> Record:
        """One record of a batch."""
        if not 0 <= topic_index < len(self._records):
            raise msgspec.ValidationError(f"there is no topic {topic_index}")
        return self._records[topic_index].decode(data)


ROBOT_TOML = "robot.toml"
MODEL_TOML = "model.toml"
PATH_CSV = "path.csv"
DBC = "disco_robot.dbc"

_MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json", ".csv": "text/csv"}


def version() -> str:
    """Return the package's version, with the commit when it runs from a checkout: "0.1.0+g1a2b3c4" or "...-dirty"."""
    try:
        package = metadata.version("disco-hw")
    except metadata.PackageNotFoundError:
        package = "unknown"
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return package
    describe = ["git", "-C", str(root), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        commit = subprocess.run(describe, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return package
    return f"{package}+g{commit}"


def attachment(path: Path, name: str, kind: FileKind) -> Attachment:
    """Return a copy of a file for the log, under a name of the log's; raises InputError if it cannot be read."""
    return Attachment(name, _MEDIA_TYPES.get(path.suffix, "text/plain"), read_bytes(path, kind)[0])
