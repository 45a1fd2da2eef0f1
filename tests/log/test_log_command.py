import io
import json
import os
from datetime import datetime

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from msgspec import structs

from disco_hw.errors import InputError, LogError
from disco_hw.files import LOG
from disco_hw.log import Attachment, End
from disco_hw.log.container import MAGIC
from disco_hw.log.importing.rosbag_file import is_bag
from disco_hw.log.load import load_drive
from disco_hw.log.log_command import export, info, recover, recover_log
from disco_hw.log.reader import open_log
from disco_hw.log.records import Controller
from tests.log.processes import files_of_at_most
from tests.tables import thinned
from tools.log_samples import (
    ATTACHMENTS,
    PERIOD_NS,
    WALL_OFFSET_NS,
    bits,
    drive_ticks,
    log_bytes,
    tick,
    with_damaged_chunk,
    write_log,
)


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "run.mcap", drive_ticks(100), flush_every=10, end=End(101 * PERIOD_NS, 100, 0))


@pytest.fixture
def cut(tmp_path):
    path = tmp_path / "cut.mcap"
    data = log_bytes(drive_ticks(100), flush_every=10)
    path.write_bytes(data[: len(data) * 5 // 10])
    return path


def test_info_says_what_a_log_holds(log):
    text = info(log, as_json=False)
    for part in ("wombot", "100 ticks, 0 missing; ended properly", "/wheels", "attached: robot.toml"):
        assert part in text
    assert "lost" not in text
    summary = json.loads(info(log, as_json=True))
    assert summary["topics"]["/wheels"]["count"] == 100
    assert (summary["complete"], summary["ended"]) == (True, True)


def test_info_says_which_controller_answered_and_who_says_its_limits(tmp_path):
    agilex = Controller(5, "AgileX base", "", "", "robot.toml", fixed={"command_timeout_s": 0.5}, declared={"x_m": 2.0})
    later = structs.replace(agilex, t_ns=9, said_by="oracle")
    ticks = [(PERIOD_NS, [*tick(1), agilex]), (2 * PERIOD_NS, [*tick(2), structs.replace(agilex, t_ns=6), later])]
    text = info(write_log(tmp_path / "run.mcap", ticks), False)
    first, second = (line for line in text.splitlines() if "AgileX" in line)
    assert first == (
        "controller: AgileX base (declared in robot.toml, not reported by the controller); command_timeout_s 0.5 "
        "(which cannot be set otherwise); x_m 2 (declared in robot.toml, not reported by the controller)"
    )
    assert "AgileX base (oracle)" in second


def test_an_index_alone_does_not_prove_that_the_log_was_ended(tmp_path):
    gone = write_log(tmp_path / "gone.mcap", drive_ticks(100))
    text = info(gone, as_json=False)
    assert "ended properly" not in text
    assert "nothing recorded after 2023-11-14T22:13:22.000+00:00: the daemon or its recorder had ended" in text
    summary = json.loads(info(gone, as_json=True))
    assert (summary["complete"], summary["ended"], summary["missing_ticks"]) == (True, False, 0)


def test_what_was_given_and_never_delivered_is_missing_at_the_end(tmp_path):
    short = write_log(tmp_path / "short.mcap", drive_ticks(100), end=End(101 * PERIOD_NS, 793, 286))
    assert "100 ticks, 693 missing; ended properly" in info(short, as_json=False)


def test_a_recovered_file_of_another_writer_keeps_its_profile_and_the_times_of_what_is_attached(tmp_path):
    """Without the profile a bag of ROS 2 would be none any more."""
    source, target = tmp_path / "bag.mcap", tmp_path / "new.mcap"
    with source.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.add_attachment(5, 9, "calibration.yaml", "text/yaml", b"x: 1")
        writer.add_message(writer.register_channel("/a", "cdr", 0), 7, b"x", 7)
        writer.finish()
    recover_log(source, target)
    assert is_bag(target.read_bytes()[:64])
    with target.open("rb") as stream:
        (kept,) = make_reader(stream).iter_attachments()
    assert (kept.create_time, kept.log_time) == (5, 9)
    # Of a file whose header is damaged nothing says what it was.
    data = bytearray(source.read_bytes())
    data[len(MAGIC) + 9] = 0xFF
    source.write_bytes(data)
    assert recover_log(source, tmp_path / "no_profile.mcap").messages == 1


@pytest.mark.parametrize(
    ("step_s", "said"), [(3600.0, "3600.0 s ahead of"), (-2.5, "2.5 s behind"), (0.9, ""), (None, "")]
)
def test_info_says_that_the_wall_clock_went_on_otherwise_than_the_log(tmp_path, step_s, said):
    offset_ns = None if step_s is None else WALL_OFFSET_NS + round(step_s * 1e9)
    end = End(101 * PERIOD_NS, 100, 0, wall_offset_ns=offset_ns)
    path = write_log(tmp_path / "run.mcap", drive_ticks(100), end=end)
    text = info(path, as_json=False)
    assert (f"at its end the wall clock was {said}" in text) == bool(said)
    assert ("wall clock" in text) == bool(said)
    ended = json.loads(info(path, as_json=True))["end"]
    assert datetime.fromisoformat(ended).timestamp() == pytest.approx(
        (101 * PERIOD_NS + (offset_ns or WALL_OFFSET_NS)) * 1e-9, abs=2e-3
    )


def test_a_later_part_says_what_it_continues_and_what_is_missing_in_between(tmp_path):
    later = [(k * PERIOD_NS, tick(k)) for k in range(31, 51)]
    part = {"part": 2, "continues": "/logs/run.mcap", "continues_sequence": 27, "end": End(51 * PERIOD_NS, 50, 0)}
    path = write_log(tmp_path / "run.part2.mcap", later, numbers=True, **part)
    text = info(path, as_json=False)
    assert "20 ticks, 3 missing; ended properly" in text
    assert "continues /logs/run.mcap" in text


def test_of_a_log_from_before_the_recorders_last_word_nothing_is_claimed(tmp_path):
    old, new = (b"\x06\0\0\0format\x01\0\0\0" + version for version in (b"1", b"2"))
    data = log_bytes(drive_ticks(10))
    assert data.count(new) == 1
    old_log = tmp_path / "old.mcap"
    old_log.write_bytes(data.replace(new, old))
    text = info(old_log, as_json=False)
    assert "the file is whole, and its version did not record whether its recorder ended it" in text


def test_info_says_what_is_lost(cut):
    text = info(cut, as_json=False)
    assert "; nothing recorded after 2023-11-14T22:13:21" in text
    assert "ended properly" not in text
    assert "lost: at byte" in text
    assert json.loads(info(cut, as_json=True))["damage"]


def test_recover_says_what_came_over_and_what_not(cut, log, tmp_path):
    text = recover(cut, tmp_path / "a.mcap", as_json=False)
    assert "chunks, 2 attachments" in text
    assert "lost: " in text
    assert "lost: " in info(tmp_path / "a.mcap", as_json=False)
    plain = json.loads(recover(log, tmp_path / "b.mcap", as_json=True))
    assert plain["out"] == str(tmp_path / "b.mcap")
    assert (plain["chunks"], plain["lost"]) == (10, [])
    assert "nothing was lost" in recover(log, tmp_path / "c.mcap", as_json=False)


def test_export_writes_the_csv(log, tmp_path):
    text = export(log, tmp_path / "a.csv", as_json=False)
    header = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()[0]
    assert "rows, 1 segment\n" in text + "\n"
    assert header.startswith("t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_ticks,enc_right_ticks,enc_left_rad_s")
    plain = json.loads(export(log, tmp_path / "b.csv", as_json=True))
    assert plain["rows"] == len((tmp_path / "b.csv").read_text(encoding="utf-8").splitlines()) - 1


@pytest.mark.parametrize(
    ("robot", "ticks_per_rev"),
    [("ticks_per_rev = 2796.8", 2796.8), ("ticks_per_rev = 4096.0", 4096.0), ("", None), ("ticks_per_rev = inf", None)],
)
def test_export_writes_angles_for_any_ticks_of_a_revolution_or_says_why_not(tmp_path, robot, ticks_per_rev):
    kept = (Attachment("robot.toml", "application/toml", f"[robot]\n{robot}\n".encode()),)
    source = write_log(tmp_path / "run.mcap", drive_ticks(100), attachments=kept)
    text = export(source, tmp_path / "a.csv", as_json=False)
    assert ("run.mcap: the wheel angles were left out: its robot.toml does not say" in text) == (ticks_per_rev is None)
    wheels = load_drive(tmp_path / "a.csv", ticks_per_rev).wheels
    assert wheels.angle_measured == (ticks_per_rev is not None)
    expected = load_drive(source).wheels.left_angle_rad - 0.04
    assert wheels.left_angle_rad - wheels.left_angle_rad[0] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("command", [lambda path: info(path, False), lambda path: export(path, path, False)])
def test_what_is_no_log_is_refused(tmp_path, command):
    path = tmp_path / "x"
    path.write_bytes(b"nothing of ours")
    with pytest.raises(LogError, match="not an MCAP file"):
        command(path)


COMPLETE_LOG = log_bytes(drive_ticks(300), flush_every=10)


@pytest.fixture
def source(tmp_path):
    return tmp_path / "cut.mcap"


@pytest.fixture
def target(tmp_path):
    return tmp_path / "mended.mcap"


def entries(path):
    with open_log(path) as log:
        return [(entry.topic, entry.now_ns, entry.tick, bits(entry.record)) for entry in log.records()]


@thinned("tenth", range(1, 11), quick=3)
def test_every_whole_chunk_comes_over_and_the_loss_is_named(source, target, tenth):
    source.write_bytes(COMPLETE_LOG[: len(COMPLETE_LOG) * tenth // 10])
    recovered = recover_log(source, target)
    assert entries(target) == entries(source)
    assert recovered.chunks * 10 == len({tick for _, _, tick, _ in entries(target)})
    assert recovered.attachments == len(ATTACHMENTS)
    assert bool(recovered.lost) == (tenth < 10)
    with open_log(source) as damaged, open_log(target) as mended:
        assert mended.complete
        assert mended.damage == damaged.damage == recovered.lost
        assert mended.metadata == damaged.metadata
        assert mended.attachment("robot.toml") == damaged.attachment("robot.toml")


def test_a_recovered_log_is_whole_for_other_readers_too(source, target):
    source.write_bytes(COMPLETE_LOG[: len(COMPLETE_LOG) // 2])
    recovered = recover_log(source, target)
    reader = make_reader(io.BytesIO(target.read_bytes()), validate_crcs=True)
    messages = list(reader.iter_messages())
    assert len(messages) == recovered.messages == reader.get_summary().statistics.message_count
    assert all(schema is not None for schema, _, _ in messages)


def test_damage_inside_a_complete_log_costs_the_chunk(source, target):
    source.write_bytes(with_damaged_chunk(COMPLETE_LOG))
    recovered = recover_log(source, target)
    assert len(recovered.lost) == 1
    assert len({tick for _, _, tick, _ in entries(target)}) == 290
    with open_log(target) as log:
        assert log.summary().missing_ticks == 10


def test_a_log_of_any_size_is_recovered(source, target):
    source.write_bytes(COMPLETE_LOG)
    os.truncate(source, LOG.most_bytes + 1)
    with pytest.raises(InputError, match="too large to be a log"):
        open_log(source)
    assert recover_log(source, target).attachments == len(ATTACHMENTS)
    with open_log(target) as log:
        assert log.summary().ticks == 300


def test_damage_between_the_chunks_costs_nothing(source, target, tmp_path):
    sound = tmp_path / "sound.mcap"
    sound.write_bytes(COMPLETE_LOG)
    damaged = bytearray(COMPLETE_LOG)
    index = make_reader(io.BytesIO(COMPLETE_LOG)).get_summary().chunk_indexes[9]
    damaged[index.chunk_start_offset + index.chunk_length + index.message_index_length // 2] ^= 1
    source.write_bytes(damaged)
    assert not recover_log(source, target).lost
    assert entries(target) == entries(source) == entries(sound)


def test_the_source_is_not_touched_and_nothing_is_overwritten(source):
    source.write_bytes(COMPLETE_LOG[:20_000])
    with pytest.raises(LogError, match="already exists"):
        recover_log(source, source)
    assert source.read_bytes() == COMPLETE_LOG[:20_000]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty file"),
        (b"no log", "not an MCAP file"),
        (MAGIC, "no message in it can be read; there is nothing to recover"),
        (log_bytes([]), "no message in it can be read"),
        (COMPLETE_LOG[:2000], "no message in it can be read"),
    ],
    ids=["empty", "other", "magic alone", "no records", "cut before its first chunk"],
)
def test_of_nothing_nothing_is_recovered_and_no_target_left_behind(source, target, content, message):
    source.write_bytes(content)
    with pytest.raises(LogError, match=message) as refused:
        recover_log(source, target)
    assert "\n" not in str(refused.value)
    assert not target.exists()


def packed_otherwise(**options):
    """A sound MCAP file of another writer."""
    sink = io.BytesIO()
    writer = Writer(sink, chunk_size=1000, **options)
    writer.start()
    channel = writer.register_channel("/other", "json", writer.register_schema("x", "jsonschema", b"{}"))
    for k in range(100):
        writer.add_message(channel, k, b"{}" * 20, k, k)
    writer.finish()
    return sink.getvalue()


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"compression": CompressionType.LZ4}, "its chunks are packed with lz4"),
        ({"use_chunking": False}, "its messages are not in chunks"),
    ],
    ids=["lz4", "unchunked"],
)
def test_a_sound_log_that_is_packed_otherwise_is_not_called_empty(tmp_path, target, options, what):
    source = tmp_path / "my log.mcap"
    source.write_bytes(packed_otherwise(**options))
    refusal = f"{source}: {what}, which disco-hw does not read; pack it anew: `mcap compress '{source}' -o NEW.mcap`"
    for read in (lambda: recover_log(source, target), lambda: open_log(source)):
        with pytest.raises(LogError) as refused:
            read()
        assert str(refused.value) == refusal
    assert not target.exists()


def test_chunks_without_their_index_are_read(source, target):
    source.write_bytes(packed_otherwise(index_types=IndexType.NONE))
    assert recover_log(source, target).messages == 100


def test_a_disk_full_on_the_way_leaves_no_target_behind(source, target):
    source.write_bytes(COMPLETE_LOG[:-1000])
    with files_of_at_most(20_000), pytest.raises(LogError, match="File too large"):
        recover_log(source, target)
    assert not target.exists()


def test_places_that_cannot_be_read_or_written_are_named(source, target, tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        recover_log(source, target)
    source.write_bytes(COMPLETE_LOG)
    with pytest.raises(InputError, match="No such file"):
        recover_log(source, tmp_path / "no directory" / "y")
