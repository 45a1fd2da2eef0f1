import os
import signal
import stat
import time
from pathlib import Path

import pytest

from disco_hw.log.errors import LogError
from disco_hw.log.reader import open_log
from disco_hw.log.recorder import (
    MemoryRecorder,
    NullRecorder,
    ProcessRecorder,
    Recorder,
    RecorderStats,
    wall_offset_ns,
)
from disco_hw.log.records import Event
from tests.log.processes import alive, drive, recording, size, wait_until
from tools.log_samples import ATTACHMENTS, bits, tick


@pytest.fixture
def path(tmp_path):
    return tmp_path / "logs" / "run.mcap"


def recorded_ticks(path):
    with open_log(path) as log:
        return [entry.tick for entry in log.records(("/loop",))]


def test_what_is_put_is_in_the_log(path):
    recorder = ProcessRecorder(recording(path, version="9.9.9"))
    times = drive(recorder, 1, 200)
    stats = recorder.close()
    with open_log(path) as log:
        assert log.complete
        entries = list(log.records())
        summary = log.summary()
        assert log.metadata.version == "9.9.9"
        assert log.attachment_names() == tuple(kept.name for kept in ATTACHMENTS)
        assert abs(log.metadata.wall_offset_ns - wall_offset_ns()) < 10**9
    expected = [(t_ns, k, record) for k, t_ns in enumerate(times, start=1) for record in tick(k, t_ns)]
    assert bits([(entry.now_ns, entry.tick, entry.record) for entry in entries]) == bits(expected)
    assert (summary.ticks, summary.missing_ticks) == (200, 0)
    assert (stats.ticks, stats.records, stats.written) == (200, len(expected), len(expected))
    assert (stats.dropped_ticks, stats.refused, stats.writer_deaths, stats.last_error) == (0, 0, 0, "")
    assert stats.bytes == size(path)


def test_a_stopped_writer_blocks_nothing_and_what_is_dropped_is_counted_and_seen(path):
    recorder = ProcessRecorder(recording(path, queue_ticks=20))
    drive(recorder, 1, 10)
    wait_until(lambda: recorder.poll().written > 0)
    os.kill(recorder.writer_pid, signal.SIGSTOP)
    try:
        drive(recorder, 11, 1000)
        stats = recorder.poll()
    finally:
        os.kill(recorder.writer_pid, signal.SIGCONT)
    assert stats.writer_alive
    assert stats.dropped_ticks > 500
    assert stats.ticks + stats.dropped_ticks == 1010
    wait_until(lambda: recorder.poll().written == stats.records)
    drive(recorder, 1011, 5)
    final = recorder.close()
    ticks = recorded_ticks(path)
    assert ticks[-5:] == [1011, 1012, 1013, 1014, 1015]
    assert ticks == sorted(set(ticks))
    assert len(ticks) == final.ticks == stats.ticks + 5
    with open_log(path) as log:
        missing = sum(gap.ticks for gap in log.gaps())
        assert missing == log.summary().missing_ticks == final.dropped_ticks == stats.dropped_ticks


def test_a_tick_without_records_is_not_one_that_is_missing(path):
    recorder = ProcessRecorder(recording(path))
    for t_ns in (1, 2, 3):
        recorder.put(t_ns, [])
        recorder.put(t_ns, tick(t_ns))
    assert recorder.close().ticks == 3
    with open_log(path) as log:
        assert (log.summary().ticks, log.summary().missing_ticks) == (3, 0)


def test_a_record_that_cannot_be_encoded_costs_itself_only(path):
    recorder = ProcessRecorder(recording(path))
    bad = [Event(2**70, "info", "a", "b"), Event(1, "info", "a", object()), object()]
    recorder.put(5, [Event(1, "info", "a", "first"), *bad, Event(1, "info", "a", "last")])
    recorder.put(6, bad)
    stats = recorder.close()
    assert stats.refused == 6
    assert "could not be recorded" in stats.last_error
    with open_log(path) as log:
        assert [entry.record.text for entry in log.records()] == ["first", "last"]


def test_a_record_that_the_writer_refuses_is_counted_and_named(path):
    recorder = ProcessRecorder(recording(path))
    recorder.put(5, [Event(1, "loud" * 5000, "a", "b"), Event(1, "info", "a", "kept")])
    stats = recorder.close()
    assert (stats.refused, stats.written) == (1, 1)
    assert len(stats.last_error) < 1000
    assert "loud" in stats.last_error
    assert stats.writer_deaths == 0


def test_a_writer_killed_is_noticed_counted_and_replaced_by_another_part(path):
    recorder = ProcessRecorder(recording(path))
    drive(recorder, 1, 50)
    recorder.put(51, [Event(1, "loud", "a", "b")])
    wait_until(lambda: recorder.poll().refused > 0)
    assert not recorder.restart()
    os.kill(recorder.writer_pid, signal.SIGKILL)
    wait_until(lambda: not recorder.poll().writer_alive)
    stats = recorder.poll()
    assert stats.writer_deaths == 1
    assert "signal 9" in stats.last_error
    assert recorder.writer_pid is None
    drive(recorder, 52, 10)
    assert recorder.poll().dropped_ticks == 10
    assert recorder.poll().refused == 1
    assert recorder.restart()
    assert recorder.path == path.with_name("run.part2.mcap")
    drive(recorder, 62, 20)
    final = recorder.close()
    assert (final.writer_deaths, final.refused) == (1, 1)
    assert recorded_ticks(path) == list(range(1, 51))
    assert recorded_ticks(recorder.path)[-20:] == list(range(62, 82))
    with open_log(recorder.path) as log:
        assert (log.metadata.part, log.summary().missing_ticks) == (2, 0)


def test_a_writer_that_heard_nothing_for_long_ends_the_file_and_is_missed(path):
    recorder = ProcessRecorder(recording(path, silence_s=1.0))
    drive(recorder, 1, 5)
    wait_until(lambda: not recorder.poll().writer_alive)
    stats = recorder.poll()
    assert stats.writer_deaths == 1
    assert "heard nothing" in stats.last_error
    assert recorded_ticks(path) == [1, 2, 3, 4, 5]
    with open_log(path) as log:
        assert log.complete
    recorder.close()


def test_close_waits_no_longer_than_told_and_the_writer_finishes_by_itself(path):
    recorder = ProcessRecorder(recording(path, silence_s=0.3))
    drive(recorder, 1, 20)
    wait_until(lambda: recorder.poll().written > 0)
    writer = recorder.writer_pid
    os.kill(writer, signal.SIGSTOP)
    try:
        before = time.monotonic()
        stats = recorder.close(timeout_s=0.2)
        assert time.monotonic() - before < 5.0
        assert stats.writer_alive
    finally:
        os.kill(writer, signal.SIGCONT)
    wait_until(lambda: not alive(writer))
    with open_log(path) as log:
        assert log.complete


def test_close_twice_and_put_after_close_do_no_harm(path):
    recorder = ProcessRecorder(recording(path))
    drive(recorder, 1, 3)
    stats = recorder.close()
    recorder.put(1, tick(4))
    assert recorder.close() == stats
    assert not recorder.restart()
    assert recorded_ticks(path) == [1, 2, 3]


def test_the_socket_is_its_owners_alone_and_nothing_is_left_behind(path, runtime_root):
    recorder = ProcessRecorder(recording(path))
    (directory,) = runtime_root.iterdir()
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    threads = len(os.listdir("/proc/self/task"))
    recorder.close()
    assert list(runtime_root.iterdir()) == []
    assert len(os.listdir("/proc/self/task")) <= threads


def test_open_files_do_not_add_up(tmp_path):
    def count():
        return len(os.listdir("/proc/self/fd"))

    ProcessRecorder(recording(tmp_path / "first.mcap")).close()
    before = count()
    for k in range(3):
        ProcessRecorder(recording(tmp_path / f"{k}.mcap")).close()
    assert count() == before


def test_a_log_is_never_overwritten(path):
    path.parent.mkdir()
    path.write_text("precious", encoding="utf-8")
    with pytest.raises(LogError, match="already exists"):
        ProcessRecorder(recording(path))
    assert path.read_text(encoding="utf-8") == "precious"


def test_a_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(LogError, match=r"file.*cannot be made"):
        ProcessRecorder(recording(tmp_path / "file" / "run.mcap"))


def test_a_runtime_directory_too_deep_for_a_socket_is_named(path, monkeypatch, tmp_path):
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    with pytest.raises(LogError, match="XDG_RUNTIME_DIR"):
        ProcessRecorder(recording(path))
    assert list(deep.iterdir()) == []


def test_recorders_that_need_no_process():
    null: Recorder = NullRecorder()
    null.put(1, tick(1))
    assert null.poll() == null.close() == RecorderStats()
    memory = MemoryRecorder()
    as_recorder: Recorder = memory
    records = tick(1)
    as_recorder.put(7, records)
    assert memory.ticks == [(7, tuple(records))]
    assert as_recorder.close() == RecorderStats(ticks=1, records=len(records))


def test_the_wall_offset_is_that_of_the_wall_clock():
    assert abs(time.monotonic_ns() + wall_offset_ns() - time.time_ns()) < 10**8


def test_a_relative_path_works(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    recorder = ProcessRecorder(recording(Path("run.mcap")))
    drive(recorder, 1, 2)
    recorder.close()
    assert recorded_ticks(tmp_path / "run.mcap") == [1, 2]
