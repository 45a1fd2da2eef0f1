import io
import os
import struct
import tracemalloc
from contextlib import contextmanager
from itertools import product

import pytest
import zstandard
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from disco_hw.errors import LogError
from disco_hw.log import Attachment, container
from disco_hw.log.container import MAGIC, DamagedError, messages, read_attachment, read_chunk, read_contents
from tests.tables import examples
from tools.log_samples import ATTACHMENTS, drive_ticks, log_bytes

COMPLETE_LOG = log_bytes(drive_ticks(120), flush_every=10)
KILLED = log_bytes(drive_ticks(120), flush_every=10, finish=False)


class Opened:
    def __init__(self, data):
        self.fd = os.memfd_create("log")
        os.write(self.fd, data)

    def __enter__(self):
        return self.fd

    def __exit__(self, *_):
        os.close(self.fd)


def contents_of(data):
    with Opened(data) as fd:
        return read_contents(fd, "x.mcap")


def overwritten(data, at, new):
    return data[:at] + new + data[at + len(new) :]


def flipped(data, at, bits=1):
    """The data with some bits of one byte the other way round."""
    return overwritten(data, at, bytes([data[at] ^ bits]))


@contextmanager
def memory_below(limit):
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < limit


def sequences(data):
    """Numbers of the ticks that can be read."""
    with Opened(data) as fd:
        contents = read_contents(fd, "x.mcap")
        return sorted({message.sequence for chunk in contents.chunks for message in messages(read_chunk(fd, chunk))})


CHUNKS = contents_of(COMPLETE_LOG).chunks
THE_END_IS_MISSING = "the end is missing: the writer was killed or is still at work, or the file was cut"
ALL_BUT_THE_FIFTH = [*range(1, 41), *range(51, 121)]


@pytest.mark.parametrize(
    ("data", "damage"), [(COMPLETE_LOG, []), (KILLED, [THE_END_IS_MISSING])], ids=["indexed", "walked"]
)
def test_a_complete_file_is_read_by_its_index_and_one_without_its_end_is_walked_and_says_so(data, damage):
    contents = contents_of(data)
    assert (contents.complete, contents.damage) == (not damage, damage)
    assert len(contents.chunks) == 12
    assert sequences(data) == list(range(1, 121))


def test_index_and_walk_agree():
    indexed, walked = contents_of(COMPLETE_LOG), contents_of(KILLED)
    for name in ("chunks", "counts", "attachments", "metadata", "channels", "schemas"):
        assert getattr(indexed, name) == getattr(walked, name), name


@pytest.mark.parametrize("tenth", range(1, 10))
def test_whatever_tenth_is_left_all_its_whole_chunks_are(tenth):
    cut = len(COMPLETE_LOG) * tenth // 10
    complete_chunks = sum(chunk.offset + chunk.length <= cut for chunk in contents_of(COMPLETE_LOG).chunks)
    assert sequences(COMPLETE_LOG[:cut]) == list(range(1, 10 * complete_chunks + 1))
    assert not contents_of(COMPLETE_LOG[:cut]).complete


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.thorough)])
def test_cut_anywhere_it_reads_or_is_refused(step):
    data = log_bytes(drive_ticks(3), attachments=())
    for cut in [*range(40), *range(40, len(data) - 300, 61), *range(len(data) - 300, len(data), step)]:
        try:
            contents = contents_of(data[:cut])
        except LogError:
            assert cut < len(MAGIC)
        else:
            assert not contents.complete
            assert contents.damage


@pytest.mark.parametrize("data", [COMPLETE_LOG, KILLED], ids=["indexed", "walked"])
def test_a_damaged_chunk_costs_itself_only(data):
    chunk = CHUNKS[4]
    with Opened(flipped(data, chunk.offset + chunk.length // 2, 0x40)) as fd:
        contents = read_contents(fd, "x")
        readable = []
        for found in contents.chunks:
            try:
                readable += [message.sequence for message in messages(read_chunk(fd, found))]
            except DamagedError:
                assert found == chunk
    assert sorted(set(readable)) == ALL_BUT_THE_FIFTH
    if not contents.complete:
        assert any(f"byte {chunk.offset - 9}" in text and "are lost" in text for text in contents.damage)


def test_an_unfinished_record_is_called_so():
    last = CHUNKS[-1]
    damage = contents_of(KILLED[: last.offset + 100]).damage
    assert damage[0] == f"at byte {last.offset - 9}: an unfinished record; 109 bytes are lost"


def test_a_wrong_checksum_is_noticed_where_everything_else_fits():
    damaged = flipped(KILLED, CHUNKS[4].offset + 24)
    assert sequences(damaged) == ALL_BUT_THE_FIFTH
    assert "wrong checksum" in contents_of(damaged).damage[0]


@pytest.mark.parametrize("length", [0, 5, 2**40, 2**64 - 1])
def test_a_chunk_whose_length_is_wrong_costs_itself_only(length):
    assert sequences(overwritten(KILLED, CHUNKS[4].offset - 8, struct.pack("<Q", length))) == ALL_BUT_THE_FIFTH


def records_of(data):
    """Offset and length of each record of a file whose end is missing."""
    at, found = len(MAGIC), []
    while at < len(data):
        length = 9 + struct.unpack_from("<Q", data, at + 1)[0]
        found.append((at, length))
        at += length
    return found


def test_a_flipped_bit_in_the_head_of_a_record_costs_one_chunk_at_most_and_is_named():
    killed = log_bytes(drive_ticks(40), flush_every=5, finish=False)
    whole = contents_of(killed)
    # What stands before the first chunk, and the first two chunks with the index of their messages.
    around = {length: at for at, length in records_of(killed) if at < whole.chunks[2].offset - 9}
    parts = ("chunks", "attachments", "metadata")
    for at, place, bit in product(around.values(), range(9), (0, 1, 3, 4, 6)):
        contents = contents_of(flipped(killed, at + place, 1 << bit))
        assert len(contents.chunks) >= len(whole.chunks) - 1, (at, place, bit)
        is_less = any(len(getattr(contents, part)) < len(getattr(whole, part)) for part in parts)
        assert not is_less or len(contents.damage) > len(whole.damage), (at, place, bit)


def test_a_hole_of_zeros_costs_what_it_covers_only():
    start, end = CHUNKS[3].offset + 20, CHUNKS[6].offset - 30
    assert sequences(overwritten(KILLED, start, bytes(end - start))) == [*range(1, 31), *range(61, 121)]


def test_an_unusable_index_is_walked_around():
    damaged = flipped(COMPLETE_LOG, len(COMPLETE_LOG) - 200)
    assert "index at the end is unusable" in contents_of(damaged).damage[-1]
    assert sequences(damaged) == list(range(1, 121))


def record(opcode, content):
    return bytes([opcode]) + struct.pack("<Q", len(content)) + content


def chunk_of(packed, claims):
    """The record of a packed chunk that claims to hold so many bytes."""
    head = struct.pack("<QQQI", 0, 0, claims, 0) + b"\x04\0\0\0zstd"
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def chunk_record(data, claims=None):
    return chunk_of(zstandard.compress(data), len(data) if claims is None else claims)


@pytest.mark.parametrize(
    "inner",
    [
        bytes([Opcode.MESSAGE]) + struct.pack("<Q", 1000) + bytes(30),
        record(Opcode.MESSAGE, bytes(5)),
        bytes([Opcode.MESSAGE]) + b"\0\0",
        record(Opcode.SCHEMA, bytes(3)),
        record(Opcode.CHANNEL, b"\xff\xff\xff\xff"),
    ],
    ids=["too long", "too short", "cut off", "schema", "channel"],
)
def test_nonsense_inside_a_chunk_costs_the_chunk(inner):
    contents = contents_of(MAGIC + chunk_record(inner))
    assert contents.chunks == []
    assert len(contents.damage) == 2


def test_a_damaged_attachment_is_left_out():
    at = KILLED.index(ATTACHMENTS[0].data)
    damaged = flipped(KILLED, at)
    contents = contents_of(damaged)
    assert [kept.name for kept in contents.attachments] == [ATTACHMENTS[1].name]
    assert "wrong checksum" in contents.damage[0]
    assert sequences(damaged) == list(range(1, 121))
    with Opened(flipped(COMPLETE_LOG, at)) as fd, pytest.raises(DamagedError, match="wrong checksum"):
        read_attachment(fd, read_contents(fd, "x").attachments[0])


@pytest.mark.parametrize(
    ("size", "claims", "text"), [(2**20, 2**40, "claims"), (2**27, 100, "")], ids=["enormous", "more than it says"]
)
def test_a_chunk_that_claims_a_wrong_size_takes_no_memory(size, claims, text):
    data = MAGIC + chunk_record(bytes(size), claims)
    with memory_below(2**24):
        contents = contents_of(data)
    assert contents.chunks == []
    assert text in contents.damage[0]


@pytest.mark.parametrize("data", [b"", b"hello", b"t_s,cmd\n", MAGIC[:-1], bytes(100)])
def test_what_is_no_mcap_file_is_refused_in_one_line(data):
    with pytest.raises(LogError) as refused:
        contents_of(data)
    assert str(refused.value).startswith("x.mcap: ")
    assert "\n" not in str(refused.value)


def test_a_file_of_bombs_is_refused_chunk_by_chunk_without_unpacking_one():
    bomb = chunk_record(bytes(2**20))
    assert len(bomb) < 200
    with memory_below(2**21):
        contents = contents_of(MAGIC + 500 * bomb)
    assert contents.chunks == []
    assert "a chunk that claims to be 1048576 bytes, packed in" in contents.damage[0]
    # What is wrong in hundreds of places is not reported one by one.
    assert len(contents.damage) == 102
    assert contents.damage[-2:] == ["at 400 further places something is lost", THE_END_IS_MISSING]


def test_a_chunk_may_be_packed_well(monkeypatch):
    """At the limit it is read, a byte beyond it not."""
    inner = record(Opcode.DATA_END, bytes(30_000))
    packed = len(zstandard.compress(inner))
    for free, read in ((len(inner) - 128 * packed, True), (len(inner) - 128 * packed - 1, False)):
        monkeypatch.setattr(container, "_UNPACKED_FREE", free)
        assert bool(contents_of(MAGIC + chunk_record(inner)).chunks) == read


def test_the_holes_of_a_sparse_file_are_skipped_and_a_chunk_behind_one_is_found():
    with Opened(MAGIC) as fd:
        os.ftruncate(fd, 2**43)
        contents = read_contents(fd, "x")
    assert contents.chunks == []
    assert "are lost" in contents.damage[0]
    with Opened(MAGIC + b"\0") as fd:
        os.pwrite(fd, chunk_record(record(Opcode.DATA_END, bytes(3))), 2**32 + 5)
        contents = read_contents(fd, "x")
    assert [found.offset for found in contents.chunks] == [2**32 + 5 + 9]


def test_after_the_last_record_nothing_more_is_looked_for():
    """What follows the end of the data, here a chunk once more, is no data."""
    end, chunk = record(Opcode.DATA_END, bytes(4)), chunk_record(b"")
    assert len(contents_of(MAGIC + chunk + end + chunk).chunks) == 1
    assert len(contents_of(MAGIC + chunk + chunk).chunks) == 2


def with_attached_chunk():
    """A log in which another is attached, the place of the attached one, and that of its record's length."""
    attached = chunk_record(record(Opcode.DATA_END, b"in"))
    files = (Attachment("log.mcap", "application/mcap", attached),)
    data = log_bytes(drive_ticks(3), finish=False, attachments=files)
    at = data.index(attached)
    # The record: opcode, length, log time, create time, then name, media type and data, each after its own length.
    return data, at, at - 8 - 4 - len("application/mcap") - 4 - len("log.mcap") - 16 - 8


def test_what_is_attached_and_damaged_is_no_part_of_the_log_even_at_its_end():
    data, at, length_at = with_attached_chunk()
    damaged = flipped(data, at - 1 - 8)
    contents = contents_of(damaged)
    assert len(contents.damage) == 2
    assert sequences(damaged) == [1, 2, 3]
    assert len(contents.chunks) == 1
    (length,) = struct.unpack_from("<Q", data, length_at)
    contents = contents_of(damaged[: length_at + 8 + length])
    assert contents.chunks == []
    assert contents.damage[0].endswith(f"; {9 + length} bytes are lost")


@pytest.mark.parametrize("length", [2**63 - 1, 2**64 - 1])
def test_what_follows_something_whose_length_cannot_be_is_found(length):
    data, _, length_at = with_attached_chunk()
    data = overwritten(data, length_at, struct.pack("<Q", length))
    assert sequences(data) == [1, 2, 3]
    # The attached one has a mark of a chunk as well, and where the record ends is not known.
    assert len(contents_of(data).chunks) == 2


@pytest.mark.parametrize("with_size", [True, False])
def test_chunks_are_read_whether_or_not_their_frame_says_how_long_it_is(with_size):
    inner = record(Opcode.DATA_END, bytes(400))
    body = zstandard.ZstdCompressor(write_content_size=with_size).compress(inner)
    assert (zstandard.frame_content_size(body) == -1) is not with_size
    for claims, read in ((len(inner), True), (len(inner) - 1, False), (len(inner) + 1, False)):
        assert bool(contents_of(MAGIC + chunk_of(body, claims)).chunks) == read


def test_the_files_of_other_writers_are_read():
    for compression in (CompressionType.ZSTD, CompressionType.NONE):
        sink = io.BytesIO()
        writer = Writer(sink, chunk_size=1000, compression=compression)
        writer.start()
        channel = writer.register_channel("/other", "json", writer.register_schema("x", "jsonschema", b"{}"))
        for k in range(100):
            writer.add_message(channel, k, b"{}" * 20, k, k)
        writer.finish()
        assert sequences(sink.getvalue()) == list(range(100))


def read_all(data):
    with Opened(data) as fd:
        contents = read_contents(fd, "x")
        readers = [lambda chunk=chunk: list(messages(read_chunk(fd, chunk))) for chunk in contents.chunks]
        readers += [lambda kept=kept: read_attachment(fd, kept) for kept in contents.attachments]
        for read in readers:
            try:
                read()
            except DamagedError:
                assert contents.complete


SMALL = log_bytes(drive_ticks(20), flush_every=5)
CHANGE = st.tuples(st.integers(0, len(SMALL) - 1), st.binary(min_size=1, max_size=9))


@examples(quick=80, every=300, changes=st.lists(CHANGE, min_size=1, max_size=4))
def test_no_corruption_gets_more_than_one_error_out_of_it(changes):
    data = bytearray(SMALL)
    for at, new in changes:
        data[at : at + len(new)] = new
    try:
        read_all(data)
    except LogError:
        assert data[:8] != MAGIC


RECORD = st.tuples(st.integers(0, 20), st.integers(0, 2**64 - 1) | st.integers(0, 80), st.binary(max_size=80))


@examples(quick=60, every=200, records=st.lists(RECORD))
def test_no_made_up_records_get_anything_out_of_it(records):
    read_all(MAGIC + b"".join(bytes([op]) + struct.pack("<Q", length) + content for op, length, content in records))
    read_all(MAGIC + b"".join(record(op, body) for op, _, body in records))
