"""A bag of ROS 2 (MCAP, sqlite3) or ROS 1, read through `rosbags`: topics, and messages in one pass.

The library is imported when a bag is opened. A bag is foreign bytes: whatever the library makes of damage becomes one
line, and reading it may take 1.5 GiB of memory and no more.
"""

from __future__ import annotations

import os
import re
import resource
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, FileKind, open_file, read_bytes
from disco_hw.log.container import MAGIC
from disco_hw.log.importing.losses import WARNING
from disco_hw.log.importing.rosbag_salvage import salvage as salvaged
from disco_hw.log.importing.rosbag_types import Definitions

METADATA = "metadata.yaml"
ROS1_MAGIC = b"#ROSBAG V"
SQLITE_MAGIC = b"SQLite format 3\0"
METADATA_BEGIN = b"rosbag2_bagfile_information"
BAG_METADATA = FileKind("the metadata of a bag", 4 * 1024 * 1024, "give the path of a bag's folder or of its file")

# Chosen: room for a large bag; a damaged size in one would ask for more.
_MOST_MEMORY_BYTES = 1536 * 1024 * 1024
# Chosen: above what recorded messages shrink by; more is made to fill a disk.
_MOST_UNPACKED_RATIO = 256
# Chosen: far above any robot's; a damaged bag may claim any number.
_MOST_TOPICS = 10_000
_HINT = "record it again, or convert it to an MCAP where it was recorded"


def is_bag(begin: bytes) -> bool:
    """Whether a file that begins with these bytes is a bag; of a folder its metadata.yaml is looked at."""
    if begin.startswith(MAGIC):
        # Magic, opcode and length of the header, length of the profile, profile.
        return begin[len(MAGIC) + 13 :].startswith(b"ros2")
    return begin.startswith((ROS1_MAGIC, SQLITE_MAGIC, METADATA_BEGIN))


@dataclass(frozen=True, slots=True)
class BagTopic:
    """A topic of a bag, with ROS's name of its type."""

    name: str
    type: str
    count: int


@dataclass(frozen=True, slots=True)
class BagMessage:
    """One message, with the time of its recording."""

    topic: str
    log_ns: int
    value: Any  # Any: a class that `rosbags` makes of the message's definition.


@dataclass(slots=True)
class Undecoded:
    """Count of the messages of a topic that cannot be decoded, with the error of the first."""

    count: int = 0
    first: str = ""

    def add(self, fault: str) -> None:
        """Count one more message that cannot be decoded."""
        self.count, self.first = self.count + 1, self.first or fault


@dataclass(frozen=True)
class Bag:
    """Open bag, whose messages can be read any number of times."""

    path: Path
    topics: dict[str, BagTopic]
    start_ns: int
    end_ns: int
    notes: tuple[str, ...]
    _readers: tuple[Any, ...]  # Any: the library's readers, one for each file that is read by itself.
    _read: Callable[[bytes, str], Any]
    _definitions: Definitions
    _faults: dict[str, str] = field(default_factory=dict)

    def why_unreadable(self, topic: str) -> str:
        """Return why no message of a topic can be read; empty if one can. Parses the bag's definition of its type."""
        if topic not in self._faults:
            self._faults[topic] = self._fault(topic)
        return self._faults[topic]

    def _fault(self, topic: str) -> str:
        kind = self.topics[topic].type
        connections = (one for reader in self._readers for one in reader.connections)
        one = next(one for one in connections if (one.topic, one.msgtype) == (topic, kind))
        fault = self._definitions.fault(one)
        undecoded: dict[str, Undecoded] = {}
        if not fault and next(self.messages([topic], undecoded=undecoded), None) is None and topic in undecoded:
            fault = f"none of its messages can be decoded ({undecoded[topic].first})"
        return fault

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, undecoded: dict[str, Undecoded] | None = None
    ) -> Iterator[BagMessage]:
        """Messages of these topics in the order of their recording.

        A message that cannot be decoded costs no other: it is left out, and counted in `undecoded` by its topic.
        """
        found: dict[str, Undecoded] = {} if undecoded is None else undecoded
        for reader in self._readers:
            connections = [one for one in reader.connections if one.topic in topics and self._is_readable(one)]
            if connections and (start_ns is None or reader.end_time > start_ns):
                yield from self._of_a_reader(reader, connections, start_ns, found)

    def _of_a_reader(
        self, reader: Any, connections: Sequence[Any], start_ns: int | None, undecoded: dict[str, Undecoded]
    ) -> Iterator[BagMessage]:
        with _in_one_line(self.path):
            found = reader.messages(connections=connections, start=start_ns)
        while True:
            with _in_one_line(self.path):
                one = next(found, None)
            if one is None:
                return
            connection, log_ns, data = one
            try:
                with _in_one_line(self.path, f"a message of {connection.topic} ({connection.msgtype})"):
                    value = self._read(data, connection.msgtype)
            except DamagedBagError as error:
                undecoded.setdefault(connection.topic, Undecoded()).add(message_of(error.__cause__ or error))
                continue
            yield BagMessage(connection.topic, log_ns, value)

    def _is_readable(self, connection: Any) -> bool:  # Any: a connection of the library.
        return self.topics[connection.topic].type == connection.msgtype and not self._definitions.fault(connection)


class DamagedBagError(LogError):
    """A bag whose files cannot be read to their end; opened with `salvage` it may give what is whole."""


@contextmanager
def open_bag(path: Path, *, salvage: bool = False) -> Iterator[Bag]:
    """Open a bag, which is a folder, its metadata.yaml, or one .mcap, .db3 or .bag; raises LogError and InputError.

    A folder whose metadata.yaml is missing or wrong is read by its files. Raises DamagedBagError where a file cannot be
    read; with `salvage` whatever is whole of each file is copied to a temporary place and read from there.
    """
    try:
        import rosbags  # noqa: F401, PLC0415
    except ImportError:
        raise InputError(f"{path}: reading a bag needs rosbags; pip install 'disco-hw[ros2]'") from None
    path = path.parent if path.name == METADATA else path
    with _bounded_memory(), ExitStack() as stack:
        notes: list[str] = []
        readers, is_ros1 = _readers(path, stack, notes, salvage)
        with _in_one_line(path):
            from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415

            # The messages that are used are the same from Humble to Kilted.
            store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
            topics = _topics(path, readers)
            start_ns = min(reader.start_time for reader in readers)
            end_ns = max(reader.end_time for reader in readers)
        read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        yield Bag(path, topics, start_ns, end_ns, tuple(notes), tuple(readers), read, Definitions(store))


def _readers(path: Path, stack: ExitStack, notes: list[str], salvage: bool) -> tuple[list[Any], bool]:
    """Open readers (the library's) of a bag, in order of time, and whether it is of ROS 1."""
    if not path.is_dir():
        is_ros1 = _check_file(path)
        return [_opened(path, is_ros1, stack, notes, salvage)], is_ros1
    _check_folder(path)
    inside = sorted(
        (one for one in path.iterdir() if one.suffix in SUFFIXES.values()), key=lambda one: _natural(one.name)
    )
    fault, prefix = f"it has no {METADATA}", ""
    if (path / METADATA).exists() and not salvage:
        try:
            return [_opened(path, False, stack, notes, salvage=False)], False
        except DamagedBagError as error:
            if not inside:
                raise
            # A file that it names may be missing.
            fault, prefix = str(error).partition(": ")[2].partition(";")[0], WARNING
    if not inside:
        raise LogError(f"{path}: a folder without {METADATA} and without a bag; give the folder or file of a bag")
    kinds = {_check_file(one) for one in inside}
    if len(kinds) > 1:
        raise LogError(f"{path}: holds bags of ROS 1 and ROS 2; give one of its files")
    notes.append(f"{prefix}{path}: read by its files ({', '.join(one.name for one in inside)}), as {fault}")
    readers = [_opened(one, kinds == {True}, stack, notes, salvage) for one in inside]
    return sorted(readers, key=lambda reader: int(reader.start_time)), kinds == {True}


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key by which log_10 comes after log_9."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def _opened(path: Path, is_ros1: bool, stack: ExitStack, notes: list[str], salvage: bool) -> Any:  # Any: the library's.
    """Return an open reader of a bag or file; raises DamagedBagError."""
    from rosbags import rosbag1, rosbag2  # noqa: PLC0415

    if salvage:
        found = salvaged(path, Path(stack.enter_context(TemporaryDirectory(prefix="disco-hw-bag-"))))
        if found is None:
            raise DamagedBagError(f"{path}: nothing in it can be read; {_HINT}")
        path, damage = found[0], f"{path}: damaged, or its recording did not end regularly: {found[1]}"
        notes.append(f"{WARNING}{damage}")
    try:
        with _in_one_line(path):
            reader = rosbag1.Reader(path) if is_ros1 else rosbag2.Reader(path)
            reader.open()
    except DamagedBagError:
        raise
    except LogError as error:
        raise DamagedBagError(str(error)) from None
    stack.callback(reader.close)
    return reader


SUFFIXES = {MAGIC: ".mcap", SQLITE_MAGIC: ".db3", ROS1_MAGIC: ".bag"}
"""How the name of a bag's file ends, by its first bytes."""


def _check_file(path: Path) -> bool:
    """Refuse a file that is no bag, before the library waits for it; return whether it is a bag of ROS 1."""
    descriptor = open_file(path, LOG)
    try:
        begin = os.pread(descriptor, 64, 0)
    finally:
        os.close(descriptor)
    suffix = next((suffix for magic, suffix in SUFFIXES.items() if begin.startswith(magic)), None)
    if suffix is None:
        raise LogError(f"{path}: not a bag; give a bag's folder, or its .mcap, .db3 or .bag file")
    if path.suffix != suffix:
        raise LogError(f"{path}: its content is that of a {suffix} file; give it a name that ends in {suffix}")
    return suffix == ".bag"


def _check_folder(path: Path) -> None:
    """Refuse what the library would wait for or fill a disk with."""
    content = read_bytes(path / METADATA, BAG_METADATA)[0] if (path / METADATA).exists() else b""
    is_file_compressed = b"COMPRESSION_MODE: FILE" in content.upper()
    for one in sorted(path.iterdir()):
        if one.is_dir():
            continue
        os.close(open_file(one, LOG))
        if is_file_compressed and one.suffix in {".zstd", ".zst"}:
            _check_unpacked(one)


def _check_unpacked(path: Path) -> None:
    """Raise LogError for a compressed file that unpacks to too much, as the library unpacks it onto the disk."""
    import zstandard  # noqa: PLC0415

    most = min(LOG.most_bytes, _MOST_UNPACKED_RATIO * max(path.stat().st_size, 4096))
    size = 0
    with os.fdopen(open_file(path, LOG), "rb") as file, _in_one_line(path):
        for block in zstandard.ZstdDecompressor().read_to_iter(file):
            size += len(block)
            if size > most:
                raise LogError(f"{path}: unpacks to over {most // 2**20} MiB; unpack it with `zstd -d` and give that")


def _topics(path: Path, readers: Sequence[Any]) -> dict[str, BagTopic]:  # Any: the library's class.
    connections = [one for reader in readers for one in reader.connections]
    if len(connections) > _MOST_TOPICS * len(readers):
        raise LogError(f"{path}: {len(connections)} topics, over {_MOST_TOPICS}; record fewer")
    topics: dict[str, BagTopic] = {}
    for one in connections:
        former = topics.get(one.topic)
        if former is not None and former.type != one.msgtype:
            # Two publishers of different types: ROS itself lets nobody hear both.
            continue
        count = one.msgcount + (former.count if former is not None else 0)
        topics[one.topic] = BagTopic(one.topic, one.msgtype, count)
    return topics


@contextmanager
def _in_one_line(path: Path, what: str = "the bag") -> Iterator[None]:
    """Whatever the library, and the libraries under it, raise of a foreign file."""
    try:
        yield
    except InputError:
        raise
    except MemoryError:
        most = f"{_MOST_MEMORY_BYTES / 2**30:.1f} GiB"
        raise LogError(f"{path}: {what} needs over {most} of memory, as sizes in it say; {_HINT}") from None
    except Exception as error:
        raise DamagedBagError(f"{path}: {what} cannot be read ({message_of(error)}); {_HINT}") from error


def message_of(error: BaseException) -> str:
    """Format the message of a library's exception as one short line."""
    return " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__


@contextmanager
def _bounded_memory() -> Iterator[None]:
    """Chunks and lists that claim any size they like fail as a MemoryError instead of filling the machine."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    limits = [used + _MOST_MEMORY_BYTES, *(one for one in (soft, hard) if one != resource.RLIM_INFINITY)]
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
