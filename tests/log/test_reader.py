from contextlib import contextmanager
from pathlib import Path
from tempfile import NamedTemporaryFile

import numpy as np
import pytest
from hypothesis import strategies as st
from mcap.writer import Writer

from disco_hw.errors import InputError, LogError
from disco_hw.log.load import load_drive
from disco_hw.log.log_command import export, info
from disco_hw.log.reader import Gap, open_log
from disco_hw.log.records import Counters, Estimate, Event, Innovation, Plan
from disco_hw.runtime.replay import replay
from disco_hw.viewer.recording import Recording
from tests.log.any_record import ANY_RECORD
from tests.tables import examples
from tools.log_samples import (
    ATTACHMENTS,
    PERIOD_NS,
    ROBOT_TOML,
    WALL_OFFSET_NS,
    bits,
    drive_ticks,
    log_bytes,
    tick,
    with_damaged_chunk,
    write_log,
)
from tools.viewer_run import ROBOT_FILE


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def log_file(path):
    return write_log(path, drive_ticks(200), flush_every=20)


@examples(quick=15, every=40, ticks=st.lists(st.lists(ANY_RECORD, min_size=1, max_size=5), min_size=1, max_size=5))
def test_ticks_come_back_to_the_last_bit_in_order(ticks):
    content = log_bytes([(10 * number, records) for number, records in enumerate(ticks, start=1)])
    with NamedTemporaryFile(suffix=".mcap") as file:
        file.write(content)
        file.flush()
        with open_log(Path(file.name)) as log:
            entries = list(log.records())
    expected = [(10 * number, number, record) for number, records in enumerate(ticks, start=1) for record in records]
    assert bits([(entry.now_ns, entry.tick, entry.record) for entry in entries]) == bits(expected)


def test_records_by_topic_and_time(log_file):
    with open_log(log_file) as log:
        entries = list(log.records(("/estimate", "/plan"), start_ns=40 * PERIOD_NS, end_ns=60 * PERIOD_NS))
        assert {type(entry.record) for entry in entries} == {Estimate, Plan}
        assert [entry.tick for entry in entries] == [k for k in range(40, 60) for _ in range(2)]
        assert list(log.records(("/motor",))) == []
        assert list(log.records((), 0, 10**12)) == []
        assert log.counts["/pose"] == 40
        assert "/motor" not in log.counts


def test_a_topic_that_no_log_has_is_refused(log_file):
    with open_log(log_file) as log, pytest.raises(LogError, match="no such topic"):
        list(log.records(("/wheel",)))


def test_columns_of_numbers_tuples_and_mappings(log_file):
    with open_log(log_file) as log:
        estimate = log.columns("/estimate")
        assert estimate["covariance"].shape == (200, 9)
        assert np.array_equal(estimate["x_m"], [0.002 * k for k in range(1, 201)])
        assert np.array_equal(estimate["now_ns"], PERIOD_NS * np.arange(1, 201))
        assert np.array_equal(log.columns("/loop")["stages_ns.plan"], np.full(200, 3_000_000))
        assert log.columns("/command", 0, 10 * PERIOD_NS)["limits"].tolist() == [("acceleration",)] * 9


def test_attachments_and_metadata(log_file):
    with open_log(log_file) as log:
        assert log.attachment_names() == tuple(kept.name for kept in ATTACHMENTS)
        assert log.attachment("robot.toml") == ROBOT_TOML
        assert (log.metadata.robot, log.metadata.wall_offset_ns) == ("wombot", WALL_OFFSET_NS)
        with pytest.raises(LogError, match=r"holds no model\.toml"):
            log.attachment("model.toml")


def test_the_summary_counts_what_was_dropped_on_the_way(tmp_path):
    ticks = drive_ticks(100)
    with open_log(write_log(tmp_path / "whole.mcap", ticks)) as log:
        assert (log.summary().missing_ticks, log.gaps()) == (0, ())
    kept = [entry for entry in ticks if entry[0] // PERIOD_NS not in (1, 2, 50)]
    with open_log(write_log(tmp_path / "gaps.mcap", kept, numbers=True)) as log:
        summary = log.summary()
        assert log.gaps() == (Gap(3 * PERIOD_NS, 2), Gap(51 * PERIOD_NS, 1))
    assert (summary.ticks, summary.missing_ticks) == (97, 3)
    assert summary.duration_s == pytest.approx(97 * PERIOD_NS * 1e-9)
    assert summary.topics["/wheels"].count == 97
    assert summary.topics["/wheels"].rate_hz == pytest.approx(50.0, rel=0.02)
    assert summary.attachments == {kept.name: len(kept.data) for kept in ATTACHMENTS}
    assert summary.start.startswith("2023-11-14T22:13:20")


def test_a_damaged_chunk_of_a_complete_log_is_an_error_with_the_remedy(path):
    path.write_bytes(with_damaged_chunk(log_bytes(drive_ticks(300))))
    with open_log(path) as log, pytest.raises(LogError, match=r"log recover") as refused:
        list(log.records())
    assert str(refused.value).count("\n") == 0


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty file"),
        (b"t_s,cmd_left_rad_s\n", "not an MCAP file"),
        (b"\x89MCAP0\r\n", "nothing of the log is left"),
        (log_bytes(drive_ticks(3)).replace(b"disco-hw", b"other-hw"), "not a log of disco-hw"),
    ],
    ids=["empty", "csv", "magic alone", "foreign"],
)
def test_what_is_no_log_is_refused_in_one_line(path, content, message):
    path.write_bytes(content)
    with pytest.raises(LogError, match=message):
        open_log(path)


def test_a_missing_file_and_a_directory_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        open_log(tmp_path / "none.mcap")
    with pytest.raises(InputError, match="cannot be"):
        open_log(tmp_path)


def test_an_empty_log_reads_as_empty_and_is_closed_twice_without_harm(path):
    log = open_log(write_log(path, []))
    assert list(log.records()) == []
    assert log.columns("/estimate")["x_m"].size == 0
    assert log.summary().duration_s == 0.0
    log.close()
    log.close()


def test_records_of_every_kind_of_column(path):
    ticks = [
        (1, [Innovation(1, (1.0, 2.0), (0.1, 0.2), 0.5, True), Counters(1, loop={"a": 1}), Event(1, "info", "a", "b")]),
        (2, [Innovation(2, (), (), float("nan"), False, "gate"), Counters(2, loop={"b": 2})]),
    ]
    with open_log(write_log(path, ticks)) as log:
        innovation = log.columns("/estimate/innovation")
        assert [value.tolist() for value in innovation["innovation"]] == [[1.0, 2.0], []]
        assert innovation["accepted"].tolist() == [True, False]
        assert np.isnan(innovation["test_ratio"][1])
        counters = log.columns("/counters")
        assert bits(counters["loop.a"].tolist()) == bits([1.0, float("nan")])
        assert log.columns("/event")["text"].tolist() == ["b"]


def test_a_log_still_being_written_reads_as_far_as_it_goes(path):
    path.write_bytes(log_bytes([(1, tick(1)), (2, tick(2))], finish=False))
    with open_log(path) as log:
        assert [entry.tick for entry in log.records(("/loop",))] == [1, 2]
        assert not log.complete


def test_a_brief_look_gives_the_same_records_but_of_plans_the_figures_alone(log_file):
    topics = ("/plan", "/estimate", "/command")
    with open_log(log_file) as log:
        complete = [(entry.now_ns, entry.record) for entry in log.records(topics)]
        brief = list(log.brief_records(topics))
    assert len(brief) == len(complete) > 0
    for (now_ns, record), (brief_ns, short) in zip(complete, brief, strict=True):
        assert brief_ns == now_ns
        if isinstance(record, Plan):
            figures = ("t_ns", "effective_samples", "temperature", "min_cost", "mean_cost")
            assert repr([getattr(short, name) for name in figures]) == repr([getattr(record, name) for name in figures])
        else:
            assert short == record


ABOUT = {"robot": "x", "version": "7.0", "part": "1", "start_ns": "0", "wall_offset_ns": "0"}
WHEELS = '{"t_ns":%d,"received_ns":5,"left_angle_rad":0,"right_angle_rad":0,"left_speed_rad_s":1,"right_speed_rad_s":1}'


ESTIMATE = (
    '{"t_ns":%d,"x_m":0,"y_m":0,"yaw_rad":0,"covariance":[1,0,0,0,1,0,0,0,1],"speed_m_s":0,"yaw_rate_rad_s":0,'
    '"left_speed_rad_s":0,"right_speed_rad_s":0}'
)


@contextmanager
def written(path, about=None):
    """A writer of a log that no recorder of ours has written."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("disco-hw", ABOUT | (about or {}))
        yield writer
        writer.finish()


def add(writer, topic, text, log_time=10**18):
    channel = writer.register_channel(topic, "json", writer.register_schema("x", "jsonschema", b"{}"))
    writer.add_message(channel, log_time, text.encode(), 0, 1)


def hostile(path, about=None, wheels=WHEELS % 5, log_time=10**18, estimate=ESTIMATE % 5):
    with written(path, about) as writer:
        add(writer, "/wheels", wheels, log_time)
        add(writer, "/estimate", estimate, log_time)
    return path


@pytest.mark.parametrize("name", ["start_ns", "wall_offset_ns"])
@pytest.mark.parametrize("value", ["9" * 30, "-" + "9" * 30])
def test_times_that_no_clock_has_make_it_no_log_of_ours(path, name, value):
    with pytest.raises(LogError, match="not a log of disco-hw"):
        open_log(hostile(path, {name: value}))


READERS = {
    "info": lambda path, _: info(path, False),
    "export": lambda path, out: export(path, out, False),
    "drive": lambda path, _: load_drive(path),
    "records": lambda path, _: list(open_log(path).records()),
    "columns": lambda path, _: open_log(path).columns("/wheels"),
    "view": lambda path, _: Recording(path, ROBOT_FILE),
    "replay": lambda path, _: replay(path),
}


@pytest.mark.parametrize("reader", sorted(READERS))
@pytest.mark.parametrize(
    "change",
    [
        {"wheels": WHEELS % 2**63, "estimate": ESTIMATE % 2**63},
        {"wheels": WHEELS % 10**25, "estimate": ESTIMATE % 10**25},
        {"log_time": 2**64 - 1},
    ],
)
def test_a_record_at_a_time_that_no_clock_has_is_refused(path, tmp_path, change, reader):
    hostile(path, **change)
    if reader == "info" and "wheels" in change:
        # It counts and decodes nothing.
        assert READERS[reader](path, None)
        return
    with pytest.raises(InputError) as refused:
        READERS[reader](path, tmp_path / "out.csv")
    assert "\n" not in str(refused.value)
    if reader != "replay":
        assert "run.mcap: a time or count in it is beyond 64 bits" in str(refused.value)


@pytest.mark.parametrize("t_ns", [2**63 - 1, -(2**63)])
def test_the_largest_times_that_fit_are_read(path, t_ns):
    with open_log(hostile(path, wheels=WHEELS % t_ns)) as log:
        assert log.columns("/wheels")["t_ns"].tolist() == [t_ns]


@pytest.mark.parametrize("t_ns", [2**63, -(2**63) - 1])
def test_a_time_or_count_that_no_array_holds_is_refused(path, t_ns):
    with open_log(hostile(path, wheels=WHEELS % t_ns)) as log, pytest.raises(LogError, match="beyond 64 bits"):
        log.columns("/wheels")
    path.unlink()
    write_log(path, [(1, [Counters(1, loop={"ticks": 2**63})])])
    with open_log(path) as log, pytest.raises(LogError, match="beyond 64 bits"):
        list(log.records())


def test_a_record_nested_without_end_is_one_line(path):
    deep = WHEELS[:-1] % 5 + ',"more":' + "[" * 7000 + "]" * 7000 + "}"
    with open_log(hostile(path, wheels=deep)) as log, pytest.raises(LogError, match="cannot be read"):
        list(log.records())


def test_thousands_of_channels_are_read(path):
    with written(path) as writer:
        for k in range(5000):
            writer.register_channel(f"/other/{k}", "json", 0)
        add(writer, "/wheels", WHEELS % 5)
    with open_log(path) as log:
        assert log.counts == {"/wheels": 1}


@pytest.mark.parametrize("end", [{"t_ns": "9" * 30}, {"sequence": "-1"}, {"sequence": "x"}, {"sequence": "9" * 30}, {}])
def test_a_last_word_that_is_none_is_none(path, end):
    with written(path, {"format": "2"}) as writer:
        writer.add_metadata("disco-hw-end", {"t_ns": "5", "sequence": "5", "dropped_ticks": "0"} | end if end else {})
        add(writer, "/wheels", WHEELS % 5)
    with open_log(path) as log:
        assert (log.ending, log.summary().ended) == (None, False)


def test_of_a_record_that_was_written_otherwise_the_version_is_named(path):
    with pytest.raises(LogError, match=r"a record of /wheels cannot be read .*; read it with .* recorded it: 7\.0"):
        load_drive(hostile(path, wheels="{}"))
