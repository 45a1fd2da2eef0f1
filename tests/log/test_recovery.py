import io
import resource

import pytest
from mcap.reader import make_reader

from disco_hw.errors import InputError, LogError
from disco_hw.log.container import MAGIC
from disco_hw.log.reader import open_log
from disco_hw.log.recovery import recover
from tools.log_samples import ATTACHMENTS, bits, drive_ticks, log_bytes, with_damaged_chunk

WHOLE = log_bytes(drive_ticks(300), flush_every=10)


def entries(path):
    with open_log(path) as log:
        return [(entry.topic, entry.now_ns, entry.tick, bits(entry.record)) for entry in log.records()]


@pytest.mark.parametrize("tenth", range(1, 11))
def test_every_whole_chunk_comes_over_and_the_loss_is_named(tmp_path, tenth):
    source, target = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    source.write_bytes(WHOLE[: len(WHOLE) * tenth // 10])
    recovered = recover(source, target)
    assert entries(target) == entries(source)
    assert recovered.chunks * 10 == len({tick for _, _, tick, _ in entries(target)})
    assert recovered.attachments == len(ATTACHMENTS)
    assert bool(recovered.lost) == (tenth < 10)
    with open_log(source) as damaged, open_log(target) as mended:
        assert mended.complete
        assert mended.damage == damaged.damage == recovered.lost
        assert mended.metadata == damaged.metadata
        assert mended.attachment("robot.toml") == damaged.attachment("robot.toml")


def test_a_recovered_log_is_whole_for_other_readers_too(tmp_path):
    source, target = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    source.write_bytes(WHOLE[: len(WHOLE) // 2])
    recovered = recover(source, target)
    reader = make_reader(io.BytesIO(target.read_bytes()), validate_crcs=True)
    messages = list(reader.iter_messages())
    assert len(messages) == recovered.messages == reader.get_summary().statistics.message_count
    assert all(schema is not None for schema, _, _ in messages)


def test_damage_inside_a_complete_log_costs_the_chunk(tmp_path):
    source, target = tmp_path / "bad.mcap", tmp_path / "mended.mcap"
    source.write_bytes(with_damaged_chunk(WHOLE))
    recovered = recover(source, target)
    assert len(recovered.lost) == 1
    assert len({tick for _, _, tick, _ in entries(target)}) == 290
    with open_log(target) as log:
        assert log.summary().missing_ticks == 10


def test_damage_between_the_chunks_costs_nothing(tmp_path):
    source, target, sound = tmp_path / "bad.mcap", tmp_path / "mended.mcap", tmp_path / "sound.mcap"
    sound.write_bytes(WHOLE)
    damaged = bytearray(WHOLE)
    index = make_reader(io.BytesIO(WHOLE)).get_summary().chunk_indexes[9]
    damaged[index.chunk_start_offset + index.chunk_length + index.message_index_length // 2] ^= 1
    source.write_bytes(damaged)
    assert not recover(source, target).lost
    assert entries(target) == entries(source) == entries(sound)


def test_the_source_is_not_touched_and_nothing_is_overwritten(tmp_path):
    source = tmp_path / "cut.mcap"
    source.write_bytes(WHOLE[:20_000])
    with pytest.raises(LogError, match="already exists"):
        recover(source, source)
    assert source.read_bytes() == WHOLE[:20_000]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty file"),
        (b"no log", "not an MCAP file"),
        (MAGIC, "no message in it can be read; there is nothing to recover"),
        (log_bytes([]), "no message in it can be read"),
        (WHOLE[:2000], "no message in it can be read"),
    ],
    ids=["empty", "other", "magic alone", "no records", "cut before its first chunk"],
)
def test_of_nothing_nothing_is_recovered_and_no_target_left_behind(tmp_path, content, words):
    source, target = tmp_path / "x", tmp_path / "y"
    source.write_bytes(content)
    with pytest.raises(LogError, match=words) as refused:
        recover(source, target)
    assert "\n" not in str(refused.value)
    assert not target.exists()


def test_a_disk_full_on_the_way_leaves_no_target_behind(tmp_path):
    source, target = tmp_path / "cut.mcap", tmp_path / "mended.mcap"
    source.write_bytes(WHOLE[:-1000])
    resource.prlimit(0, resource.RLIMIT_FSIZE, (20_000, resource.RLIM_INFINITY))
    try:
        with pytest.raises(LogError, match="File too large"):
            recover(source, target)
    finally:
        resource.prlimit(0, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert not target.exists()


def test_places_that_cannot_be_read_or_written_are_named(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        recover(tmp_path / "none", tmp_path / "y")
    source = tmp_path / "cut.mcap"
    source.write_bytes(WHOLE)
    with pytest.raises(InputError, match="No such file"):
        recover(source, tmp_path / "no directory" / "y")
