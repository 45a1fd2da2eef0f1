"""A bag of ROS 2 (MCAP, sqlite3) or ROS 1, read through `rosbags`: topics, messages in one pass, and their times.

The library is imported when a bag is opened. A bag is foreign bytes: whatever the library makes of damage becomes one
line, and reading it may take 1.5 GiB of memory and no more.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG, FileKind, open_file, read_bytes
from disco_hw.log.container import MAGIC
from disco_hw.log.drive import Index
from disco_hw.log.importing.rosbag_types import Definitions

METADATA = "metadata.yaml"
ROS1_MAGIC = b"#ROSBAG V"
SQLITE_MAGIC = b"SQLite format 3\0"
METADATA_BEGIN = b"rosbag2_bagfile_information"
BAG_METADATA = FileKind("the metadata of a bag", 4 * 1024 * 1024, "give the path of a bag's folder or of its file")

_MOST_MEMORY_BYTES = 1536 * 1024 * 1024
_MOST_UNPACKED_RATIO = 256
_MOST_TOPICS = 10_000
_REMEDY = "mend it with `ros2 bag reindex`, `mcap recover` or `rosbag reindex`, or record it again"


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


@dataclass(frozen=True)
class Bag:
    """An open bag; its messages can be read as often as wanted."""

    path: Path
    topics: dict[str, BagTopic]
    start_ns: int
    end_ns: int
    _reader: Any
    _read: Callable[[bytes, str], Any]
    _definitions: Definitions

    def why_unreadable(self, topic: str) -> str:
        """Why messages of a topic cannot be read; empty if they can. Parses the bag's definition of its type."""
        kind = self.topics[topic].type
        one = next(one for one in self._reader.connections if (one.topic, one.msgtype) == (topic, kind))
        return self._definitions.fault(one)

    def messages(self, topics: Collection[str], start_ns: int | None = None) -> Iterator[BagMessage]:
        """Messages of these topics in the order of their recording; raises LogError for one that cannot be read."""
        wanted = [one for one in self._reader.connections if one.topic in topics and self._is_readable(one)]
        if not wanted:
            return
        with _in_one_line(self.path):
            found = self._reader.messages(connections=wanted, start=start_ns)
        while True:
            with _in_one_line(self.path):
                one = next(found, None)
            if one is None:
                return
            connection, log_ns, data = one
            with _in_one_line(self.path, f"a message of {connection.topic} ({connection.msgtype})"):
                value = self._read(data, connection.msgtype)
            yield BagMessage(connection.topic, log_ns, value)

    def _is_readable(self, connection: Any) -> bool:  # Any: a connection of the library.
        return self.topics[connection.topic].type == connection.msgtype and not self._definitions.fault(connection)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a bag: a folder with its metadata.yaml, or one .mcap, .db3 or .bag; raises LogError and InputError."""
    try:
        from rosbags import rosbag1, rosbag2  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError:
        raise InputError(f"{path}: reading a bag needs rosbags; pip install 'disco-hw[ros2]'") from None
    path = path.parent if path.name == METADATA else path
    is_ros1 = _check_files(path)
    with _bounded_memory():
        with _in_one_line(path):
            reader = rosbag1.Reader(path) if is_ros1 else rosbag2.Reader(path)
            reader.open()
        try:
            with _in_one_line(path):
                # The messages that are used are the same from Humble to Kilted.
                store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
                topics = _topics(path, reader)
                start_ns, end_ns = reader.start_time, reader.end_time
            yield Bag(path, topics, start_ns, end_ns, reader, _decoder(store, is_ros1), Definitions(store))
        finally:
            reader.close()


def _decoder(store: Any, is_ros1: bool) -> Callable[[bytes, str], Any]:
    read: Callable[[bytes, str], Any] = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
    return read


def _check_files(path: Path) -> bool:
    """Refuse what the library would wait for or fill a disk with; return whether it is a bag of ROS 1."""
    if path.is_dir():
        _check_folder(path)
        return False
    descriptor = open_file(path, LOG)
    try:
        begin = os.pread(descriptor, 64, 0)
    finally:
        os.close(descriptor)
    expected = {MAGIC: ".mcap", SQLITE_MAGIC: ".db3", ROS1_MAGIC: ".bag"}
    suffix = next((suffix for magic, suffix in expected.items() if begin.startswith(magic)), None)
    if suffix is None:
        raise LogError(f"{path}: not a bag; give a bag's folder, or its .mcap, .db3 or .bag file")
    if path.suffix != suffix:
        raise LogError(f"{path}: its content is that of a {suffix} file; give it a name that ends in {suffix}")
    return suffix == ".bag"


def _check_folder(path: Path) -> None:
    if not (path / METADATA).exists():
        inside = sorted(one.name for one in path.glob("*") if one.suffix in {".mcap", ".db3", ".bag"})
        remedy = f"give {path / inside[0]}" if inside else "give the folder or file of a bag"
        raise LogError(f"{path}: a folder without {METADATA}, which a bag has when its recording ended; {remedy}")
    content, _ = read_bytes(path / METADATA, BAG_METADATA)
    unpacked_whole = b"compression_mode: FILE" in content.upper().replace(b"COMPRESSION_MODE", b"compression_mode")
    for one in sorted(path.iterdir()):
        if one.is_dir():
            continue
        os.close(open_file(one, LOG))
        if unpacked_whole and one.suffix in {".zstd", ".zst"}:
            _check_unpacked(one)


def _check_unpacked(path: Path) -> None:
    """The library unpacks a file that was compressed as a whole onto the disk."""
    import zstandard  # noqa: PLC0415

    most = min(LOG.most_bytes, _MOST_UNPACKED_RATIO * max(path.stat().st_size, 4096))
    size = 0
    with os.fdopen(open_file(path, LOG), "rb") as file, _in_one_line(path):
        for block in zstandard.ZstdDecompressor().read_to_iter(file):
            size += len(block)
            if size > most:
                raise LogError(f"{path}: unpacks to over {most // 2**20} MiB; unpack it with `zstd -d` and give that")


def _topics(path: Path, reader: Any) -> dict[str, BagTopic]:  # Any: the library's class.
    if len(reader.connections) > _MOST_TOPICS:
        raise LogError(f"{path}: {len(reader.connections)} topics, over {_MOST_TOPICS}; record fewer")
    topics: dict[str, BagTopic] = {}
    for one in reader.connections:
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
        raise LogError(f"{path}: {what} needs over {most} of memory, as sizes in it say; {_REMEDY}") from None
    except Exception as error:
        raise LogError(f"{path}: {what} cannot be read ({_words(error)}); {_REMEDY}") from None


def _words(error: Exception) -> str:
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


_JUMP_NS = 500_000_000
_ONE_JUMP_NS = 3_000_000_000
_OTHER_CLOCK_NS = 1_000_000_000
_LEAD_NS = 50_000_000
_LARGEST_NS = 4 * 10**18


@dataclass(frozen=True, slots=True)
class Stamps:
    """Times of one topic's messages in order of their recording, all (N,), ns; a stamp of 0 is a missing one."""

    log_ns: Index
    stamp_ns: Index


@dataclass(frozen=True, slots=True)
class BagTimes:
    """Each topic's times (N,), ns, the times at which something broke off, and what a person should know."""

    t_ns: dict[str, Index]
    breaks_ns: Index
    notes: tuple[str, ...]


def timeline(stamps: Mapping[str, Stamps]) -> BagTimes:
    """Put all topics on the clock of the stamps.

    Where a clock was set (stamps go back by over 0.5 s, or ahead of the recording by that much) what follows is shifted
    back onto the clock of before, and a break marks the place. Times without a stamp are those of the recording,
    carried over to the clock of the stamps where the two are more than 1 s apart, as with a simulated clock.
    So are those of transforms that are dated ahead, to be valid for a while.
    """
    stamps = {name: Stamps(one.log_ns, _plausible(one.stamp_ns)) for name, one in stamps.items()}
    jumps = _jumps(stamps)
    shifted = {name: _without_jumps(one, jumps) for name, one in stamps.items()}
    notes = [
        f"the clock of the stamps was set {'back' if by_ns < 0 else 'ahead'} by {abs(by_ns) * 1e-9:.3g} s, "
        "which was taken out; a new segment begins there"
        for _, by_ns in jumps
    ]
    pairs = _pairs(shifted.values())
    usual_ns = float(np.median(pairs[:, 1] - pairs[:, 0])) if pairs.size else 0.0
    other_clock = abs(usual_ns) > _OTHER_CLOCK_NS
    if other_clock:
        apart_s = abs(usual_ns) * 1e-9
        notes.append(f"stamps and recording are {apart_s:.3g} s apart: a simulated clock, or one that was not set")
    times: dict[str, Index] = {}
    for name, one in shifted.items():
        missing = one.stamp_ns == 0
        lead_ns = float(np.median((one.stamp_ns - one.log_ns)[~missing])) - usual_ns if not missing.all() else 0.0
        if lead_ns > _LEAD_NS:
            notes.append(f"{name}: stamped {lead_ns * 1e-9:.2g} s ahead, as far as it is to hold; recording was taken")
            missing = np.ones_like(missing)
        elif missing.any():
            share = "no message" if missing.all() else f"{np.count_nonzero(missing)} of {missing.size} messages"
            has = "has a stamp" if missing.all() else "have no stamp"
            notes.append(f"{name}: {share} {has}; the time of recording was taken")
        recorded = _carried(one.log_ns, pairs) if other_clock else one.log_ns
        times[name] = np.where(missing, recorded, one.stamp_ns)
    breaks = np.array([at for at, _ in jumps], dtype=np.int64)
    return BagTimes(times, _carried(breaks, pairs) if other_clock else breaks, tuple(notes))


def _plausible(stamp_ns: Index) -> Index:
    return np.where((stamp_ns > 0) & (stamp_ns < _LARGEST_NS), stamp_ns, 0)


def _jumps(stamps: Mapping[str, Stamps]) -> list[tuple[int, int]]:
    """When (ns of the recording) the clock was set, and by how much (ns); topics agree on one jump."""
    found: list[tuple[int, int]] = []
    for one in stamps.values():
        found += [(int(one.log_ns[at]), by_ns) for at, by_ns in _own_jumps(one)]
    jumps: list[tuple[int, int]] = []
    cluster: list[tuple[int, int]] = []
    for jump in sorted(found):
        if cluster and jump[0] - cluster[0][0] > _ONE_JUMP_NS:
            jumps.append(_agreed(cluster))
            cluster = []
        cluster.append(jump)
    return [*jumps, _agreed(cluster)] if cluster else jumps


def _agreed(cluster: Sequence[tuple[int, int]]) -> tuple[int, int]:
    return min(at for at, _ in cluster), round(float(np.median([by_ns for _, by_ns in cluster])))


def _own_jumps(one: Stamps) -> list[tuple[int, int]]:
    """Places in a topic's messages at which its stamps jump, and by how much against the recording."""
    rows = np.flatnonzero(one.stamp_ns)
    log_ns, stamp_ns = one.log_ns[rows], one.stamp_ns[rows]
    steps = np.diff(stamp_ns)
    against = steps - np.diff(log_ns)
    age = log_ns - stamp_ns
    youngest = np.minimum.accumulate(age) if age.size else age
    # A burst after a stall has large steps too, but none of it is younger than what came before.
    ahead = (against > _JUMP_NS) & (age[1:] < youngest[:-1] - _JUMP_NS)
    found: list[tuple[int, int]] = []
    for at in np.flatnonzero((steps < -_JUMP_NS) | ahead):
        following = slice(at + 1, at + 6)
        stays = np.median(stamp_ns[following] - log_ns[following]) - (stamp_ns[at] - log_ns[at])
        # One late or early message is no jump of the clock.
        if abs(stays) > _JUMP_NS:
            found.append((int(rows[at + 1]), int(against[at])))
    return found


def _without_jumps(one: Stamps, jumps: Sequence[tuple[int, int]]) -> Stamps:
    stamp_ns = one.stamp_ns.copy()
    own = [at for at, _ in _own_jumps(one)]
    for log_ns, by_ns in jumps:
        near = [at for at in own if 0 <= one.log_ns[at] - log_ns <= _ONE_JUMP_NS]
        first = near[0] if near else int(np.searchsorted(one.log_ns, log_ns))
        stamp_ns[first:] = np.where(stamp_ns[first:] != 0, stamp_ns[first:] - by_ns, 0)
    return Stamps(one.log_ns, stamp_ns)


def _pairs(stamps: Iterable[Stamps]) -> Index:
    """Times of recording and stamps (N, 2), of the topic that has most of both, in order of recording."""
    both = [np.column_stack([one.log_ns, one.stamp_ns])[one.stamp_ns != 0] for one in stamps]
    return max(both, key=len, default=np.empty((0, 2), dtype=np.int64))


def _carried(log_ns: Index, pairs: Index) -> Index:
    """Times of recording on the clock of the stamps: interpolated between messages that have both, slope 1 beyond."""
    zero, first = int(pairs[0, 0]), int(pairs[0, 1])
    since, stamp = (pairs[:, 0] - zero).astype(np.float64), (pairs[:, 1] - first).astype(np.float64)
    at = (log_ns - zero).astype(np.float64)
    beyond = np.minimum(at - since[0], 0.0) + np.maximum(at - since[-1], 0.0)
    return np.asarray(np.rint(np.interp(at, since, stamp) + beyond).astype(np.int64) + first)
