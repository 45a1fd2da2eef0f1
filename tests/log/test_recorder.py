import errno
import os
import re
import shutil
import signal
import time
from itertools import pairwise

import pytest

from disco_hw.daemon.run import close_recorder
from disco_hw.errors import LogError
from disco_hw.log import process_recorder, writer_link
from disco_hw.log.log_command import info
from disco_hw.log.process_recorder import ProcessRecorder, wall_offset_ns
from disco_hw.log.reader import open_log
from disco_hw.log.recorder import MemoryRecorder, NullRecorder, Recorder, RecorderStats
from disco_hw.log.records import BeliefChange, DaemonState, Event, Task
from tests.log.processes import alive, drive, recorded_ticks, recording, size, wait_until
from tools.log_samples import ATTACHMENTS, bits, tick

pytestmark = pytest.mark.usefixtures("forked_keepers")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "logs" / "run.mcap"


@pytest.fixture
def recorder(path):
    return ProcessRecorder(recording(path))


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
        assert abs(log.ending.wall_offset_ns - wall_offset_ns()) < 10**9
    expected = [(t_ns, k, record) for k, t_ns in enumerate(times, start=1) for record in tick(k, t_ns)]
    assert bits([(entry.now_ns, entry.tick, entry.record) for entry in entries]) == bits(expected)
    assert (summary.ticks, summary.missing_ticks) == (200, 0)
    assert (stats.ticks, stats.records, stats.written) == (200, len(expected), len(expected))
    assert (stats.dropped_ticks, stats.refused, stats.writer_deaths, stats.last_error) == (0, 0, 0, "")
    assert stats.bytes == size(path)


def kept_going(recorder, first, until, period_s=0.01, timeout_s=60.0):
    """Put ticks numbered from `first`, and look after the recorder, until `until(stats)`; returns the next number."""
    deadline = time.monotonic() + timeout_s
    while True:
        assert time.monotonic() < deadline, recorder.poll()
        recorder.put(time.monotonic_ns(), tick(first, time.monotonic_ns()))
        first += 1
        if until(recorder.poll()):
            return first
        time.sleep(period_s)


def kept_going_until_replaced(recorder, first, deaths=1):
    """Go on until so many writers have died, and another records; returns the next number."""
    first = kept_going(recorder, first, lambda stats: stats.writer_deaths == deaths)
    return kept_going(recorder, first, lambda stats: not stats.fault)


def kept_going_after_both_died(recorder):
    """Go on until it is said that keeper and writer have died; returns the next number."""
    drive(recorder, 1, 5)
    wait_until(lambda: recorder.poll().waiting_ticks == 0)
    for process in (recorder.keeper_pid, recorder.writer_pid):
        os.kill(process, signal.SIGKILL)
    return kept_going(recorder, 6, lambda stats: "disarm to restart" in stats.fault)


def test_without_a_free_descriptor_what_has_died_is_reported_and_replaced_once_there_is_one(path, monkeypatch):
    def fail(*_):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(process_recorder, "_RETRY_S", (0.0, 0.01))
    recorder = ProcessRecorder(recording(path))
    following = kept_going(recorder, 1, lambda stats: stats.delivered_ticks > 5)
    with monkeypatch.context() as without:
        without.setattr(writer_link.socket, "socketpair", fail)
        os.kill(recorder.writer_pid, signal.SIGKILL)
        following = kept_going(recorder, following, lambda stats: "(Too many open files)" in stats.fault)
        os.kill(recorder.keeper_pid, signal.SIGKILL)
        following = kept_going(recorder, following, lambda stats: "has ended" in stats.fault)
        recorder.repair()
    recorder.repair()
    following = kept_going(recorder, following, lambda stats: not stats.fault)
    assert all_accounted(recorder.close(), following - 1)


def all_accounted(stats, given):
    """Every tick that was given is in exactly one place."""
    assert stats.ticks + stats.dropped_ticks == given
    assert stats.delivered_ticks + stats.waiting_ticks + stats.lost_ticks == stats.ticks
    return True


def test_a_stopped_writer_is_reported_within_a_second_replaced_and_nothing_is_lost(path, recorder):
    following = kept_going(recorder, 1, lambda stats: stats.delivered_ticks > 5)
    stopped = recorder.writer_pid
    polls_s = [time.monotonic()]
    os.kill(stopped, signal.SIGSTOP)
    following = kept_going(recorder, following, lambda stats: polls_s.append(time.monotonic()) or stats.fault)
    (reported,) = recorder.new_messages()
    silent_s = float(re.search(r"the log writer has not answered for (\d+\.\d) s", reported)[1])
    # Within a second, but for what this machine withheld from the one who looks.
    assert silent_s < 0.9 + max(later - earlier for earlier, later in pairwise(polls_s))
    following = kept_going_until_replaced(recorder, following)
    wait_until(lambda: not alive(stopped))
    messages = recorder.new_messages()
    assert "was stopped" in messages[0]
    # On a busy host the next writer may be late at first, which is reported too.
    assert f"recording goes on in {path.with_name('run.part2.mcap')}" in messages[1:]
    final = recorder.close()
    assert all_accounted(final, following - 1)
    assert (final.dropped_ticks, final.lost_ticks, final.waiting_ticks) == (0, 0, 0)
    first_part, second_part = recorded_ticks(path), recorded_ticks(recorder.path)
    assert first_part + second_part == list(range(1, following))
    with open_log(path) as log:
        assert log.ending is None
        assert log.summary().ended is False
    with open_log(recorder.path) as log:
        assert (log.metadata.continues, log.metadata.continues_sequence) == (str(path), first_part[-1])
        assert (log.summary().missing_ticks, log.summary().ended) == (0, True)
    assert "nothing recorded after" in info(path, as_json=False)
    assert f"continues {path}" in info(recorder.path, as_json=False)


def with_stopped_writer(path, count):
    """A recorder with a queue of 20 ticks whose writer stood still for `count` after the tenth; its counts then."""
    recorder = ProcessRecorder(recording(path, queue_ticks=20))
    drive(recorder, 1, 10)
    wait_until(lambda: recorder.poll().delivered_ticks == 10)
    os.kill(recorder.writer_pid, signal.SIGSTOP)
    drive(recorder, 11, count)
    stats = recorder.poll()
    os.kill(recorder.writer_pid, signal.SIGCONT)
    return recorder, stats


def test_what_a_queue_cannot_hold_is_counted_and_seen_in_the_log(path):
    recorder, stats = with_stopped_writer(path, 1000)
    assert (stats.dropped_ticks, stats.waiting_ticks) == (980, 20)
    assert all_accounted(stats, 1010)
    wait_until(lambda: recorder.poll().waiting_ticks == 0)
    drive(recorder, 1011, 5)
    final = recorder.close()
    assert all_accounted(final, 1015)
    assert recorded_ticks(path) == [*range(1, 31), *range(1011, 1016)]
    with open_log(path) as log:
        assert sum(gap.ticks for gap in log.gaps()) == log.summary().missing_ticks == final.dropped_ticks == 980


def test_a_queue_that_was_never_delivered_is_missing_at_the_end(path):
    recorder, _ = with_stopped_writer(path, 50)
    assert recorder.close().dropped_ticks == 30
    assert recorded_ticks(path) == list(range(1, 31))
    with open_log(path) as log:
        assert log.gaps() == ()
        assert log.summary().missing_ticks == 30


def test_a_writer_that_is_only_slow_goes_on_with_its_file(path, recorder):
    following = kept_going(recorder, 1, lambda stats: stats.delivered_ticks > 5)
    os.kill(recorder.writer_pid, signal.SIGSTOP)
    following = kept_going(recorder, following, lambda stats: stats.fault)
    os.kill(recorder.writer_pid, signal.SIGCONT)
    following = kept_going(recorder, following, lambda stats: not stats.fault)
    assert recorder.close().writer_deaths == 0
    assert recorder.new_messages()[-1] == f"recording goes on in {path}"
    assert recorded_ticks(path) == list(range(1, following))


@pytest.mark.parametrize("what", ["file", "directory"])
def test_a_file_deleted_while_it_is_written_is_reported_counted_and_begun_anew(path, recorder, what):
    following = kept_going(recorder, 1, lambda stats: stats.delivered_ticks > 20)
    if what == "file":
        path.unlink()
    else:
        shutil.rmtree(path.parent)
    following = kept_going_until_replaced(recorder, following)
    assert "was deleted while it was being written" in recorder.new_messages()[0]
    final = recorder.close()
    assert recorder.path == path.with_name("run.part2.mcap")
    assert not path.exists()
    assert all_accounted(final, following - 1)
    assert recorded_ticks(recorder.path) == list(range(final.lost_ticks + 1, following))
    assert final.lost_ticks > 20
    assert final.fault.startswith(f"{final.lost_ticks} of {following - 1} ticks are not in the log: ")
    assert recorder.new_messages()[-1] == final.fault
    with open_log(recorder.path) as log:
        assert (log.metadata.continues, log.metadata.continues_sequence) == (str(path), final.lost_ticks)


def test_a_log_deleted_before_its_end_is_not_complete_and_run_fails(path, recorder):
    drive(recorder, 1, 5)
    # What a writer that finds its file deleted has not taken in yet goes into another part and is not lost.
    wait_until(lambda: recorder.poll().delivered_ticks == 5)
    shutil.rmtree(path.parent)
    said = []
    with pytest.raises(LogError, match="the log is not complete"):
        close_recorder(recorder, lambda topic, text: said.append((topic, text)))
    assert [text for topic, text in said if topic == "recording" and "5 of 5 ticks are not in the log" in text]
    assert recorder.poll().missing_ticks == 5


def test_a_keeper_that_died_is_made_again_while_disarmed_and_the_writer_lives_on(path, recorder):
    drive(recorder, 1, 5)
    # What a writer has written and not confirmed is in the next file, too.
    wait_until(lambda: recorder.poll().waiting_ticks == 0)
    os.kill(recorder.keeper_pid, signal.SIGKILL)
    wait_until(lambda: recorder.poll() and recorder.keeper_pid is None)
    stats = recorder.poll()
    assert (stats.writer_alive, stats.fault) == (True, "")
    os.kill(recorder.writer_pid, signal.SIGKILL)
    following = kept_going(recorder, 6, lambda stats: "disarm to restart" in stats.fault)
    assert recorder.keeper_pid is None
    recorder.repair()
    following = kept_going(recorder, following, lambda stats: not stats.fault)
    assert recorder.keeper_pid is not None
    final = recorder.close()
    assert (final.dropped_ticks, final.lost_ticks) == (0, 0)
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, following))


def test_what_came_since_keeper_and_writer_died_while_armed_is_saved_at_the_end(path, recorder):
    following = kept_going_after_both_died(recorder)
    final = recorder.close(60.0)
    assert (final.delivered_ticks, final.missing_ticks, final.fault) == (following - 1, 0, "")
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, following))


def test_a_keeper_that_cannot_be_made_at_the_end_is_reported_once(recorder, monkeypatch):
    following = kept_going_after_both_died(recorder)
    recorder.new_messages()

    def fail(*_, **__):
        raise LogError("no process can be made")

    monkeypatch.setattr(writer_link, "spawn_at_normal_priority", fail)
    final = recorder.close(0.2)
    assert final.waiting_ticks == following - 1 - final.delivered_ticks > 0
    assert recorder.new_messages().count("no process can be made") == 1


STATES_IN_FORCE = (
    DaemonState(7, "READY", "BOOT"),
    BeliefChange(7, "adapted", ("a",), (0.5,), (0.1,), "newer"),
    Task(7, "circle", {"radius_m": 2.0}),
)


def in_several_parts(path, parts):
    """A recorder whose files may have 60 kB, closed in the given part, and the number of ticks that it was given."""
    recorder = ProcessRecorder(recording(path, part_bytes=60_000))
    recorder.put(1, [*tick(1), BeliefChange(5, "model"), *STATES_IN_FORCE])
    following = kept_going(recorder, 2, lambda _: recorder.path.name == f"run.part{parts}.mcap", period_s=0.001)
    return recorder, following - 1


def test_a_full_file_is_ended_and_the_log_goes_on_in_a_part_that_begins_with_what_is_in_force(path):
    recorder, given = in_several_parts(path, 3)
    final = recorder.close(60.0)
    assert all_accounted(final, given)
    assert (final.missing_ticks, final.writer_deaths, final.fault, recorder.new_messages()) == (0, 0, "", ())
    files = [path, path.with_name("run.part2.mcap"), path.with_name("run.part3.mcap")]
    ticks = [recorded_ticks(file) for file in files]
    assert [k for held in ticks for k in held] == list(range(1, given + 1))
    for before, file in pairwise(files):
        assert size(before) >= 60_000
        text = info(before, as_json=False)
        assert "0 missing; ended properly as it was full; what came after is in the next part" in text
        assert f"continues {before}" in info(file, as_json=False)
    for file, held in zip(files, ticks, strict=True):
        with open_log(file) as log:
            summary = log.summary()
            assert (log.complete, log.damage, summary.ended, summary.missing_ticks) == (True, (), True, 0)
            assert summary.continued == (file != files[-1])
            assert log.attachment_names() == tuple(kept.name for kept in ATTACHMENTS)
            states = {type(entry.record): entry for entry in log.records(("/daemon/state", "/belief", "/task"))}
            assert bits([states[type(state)].record for state in STATES_IN_FORCE]) == bits(STATES_IN_FORCE)
            assert {entry.tick for entry in states.values()} == {held[0]}


def test_without_a_keeper_a_full_file_is_not_ended(path):
    recorder = ProcessRecorder(recording(path, part_bytes=1))
    os.kill(recorder.keeper_pid, signal.SIGKILL)
    wait_until(lambda: recorder.poll() and recorder.keeper_pid is None)
    following = kept_going(recorder, 1, lambda stats: stats.delivered_ticks > 20)
    assert (recorder.close().fault, recorder.path) == ("", path)
    assert recorded_ticks(path) == list(range(1, following))


def test_a_writer_that_dies_while_it_ends_its_part_loses_nothing(path, monkeypatch):
    """Even where the recorder does not know yet what that writer confirmed."""
    recorder = ProcessRecorder(recording(path, part_bytes=30_000))
    send_end = writer_link.WriterLine.send_end

    def send_end_to_none(line, payload):
        os.kill(recorder.writer_pid, signal.SIGKILL)
        monkeypatch.setattr(writer_link.WriterLine, "send_end", send_end)
        line.ending = True

    monkeypatch.setattr(writer_link.WriterLine, "send_end", send_end_to_none)
    # Where all that was sent had been confirmed by then, its end is none of a writer that recorded.
    following = kept_going(recorder, 1, lambda stats: recorder.path != path and stats.delivered_ticks > 20)
    final = recorder.close(60.0)
    assert all_accounted(final, following - 1)
    assert (final.missing_ticks, final.writer_deaths <= 1) == (0, True)
    assert {*recorded_ticks(path), *recorded_ticks(path.with_name("run.part2.mcap"))} >= set(range(1, 20))


def test_close_while_a_part_ends_records_the_rest(path):
    recorder = ProcessRecorder(recording(path, part_bytes=1))
    drive(recorder, 1, 5)
    wait_until(lambda: recorder.poll().waiting_ticks == 0)
    # The next tick ends the part instead of being sent.
    drive(recorder, 6, 5)
    final = recorder.close(60.0)
    assert (final.delivered_ticks, final.missing_ticks, final.writer_deaths) == (10, 0, 0)
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, 11))


def test_one_writer_after_the_other_may_die(path, recorder):
    following = 1
    for deaths in (1, 2, 3):
        following = kept_going(recorder, following, lambda stats: stats.waiting_ticks < 3)
        wait_until(lambda: recorder.poll().waiting_ticks == 0)
        os.kill(recorder.writer_pid, signal.SIGKILL)
        following = kept_going_until_replaced(recorder, following, deaths)
    recorder.close()
    parts = [path, *(path.with_name(f"run.part{part}.mcap") for part in (2, 3, 4))]
    assert [k for part in parts for k in recorded_ticks(part)] == list(range(1, following))


def test_a_tick_without_records_is_not_one_that_is_missing(path, recorder):
    for t_ns in (1, 2, 3):
        recorder.put(t_ns, [])
        recorder.put(t_ns, tick(t_ns))
    assert recorder.close().ticks == 3
    with open_log(path) as log:
        assert (log.summary().ticks, log.summary().missing_ticks) == (3, 0)


def test_a_record_that_cannot_be_encoded_costs_itself_only(path, recorder):
    bad = [Event(2**70, "info", "a", "b"), Event(1, "info", "a", object()), object()]
    recorder.put(5, [Event(1, "info", "a", "first"), *bad, Event(1, "info", "a", "last")])
    recorder.put(6, bad)
    stats = recorder.close()
    assert stats.refused == 6
    assert "could not be recorded" in stats.last_error
    with open_log(path) as log:
        assert [entry.record.text for entry in log.records()] == ["first", "last"]


def test_a_record_that_the_writer_refuses_is_counted_and_named(recorder):
    recorder.put(5, [Event(1, "loud" * 5000, "a", "b"), Event(1, "info", "a", "kept")])
    stats = recorder.close()
    assert (stats.refused, stats.written, stats.writer_deaths) == (1, 1, 0)
    assert len(stats.last_error) < 1000
    assert "loud" in stats.last_error


def test_a_writer_killed_is_noticed_and_replaced_by_another_part(path, recorder):
    drive(recorder, 1, 50)
    recorder.put(51, [Event(1, "loud", "a", "b")])
    wait_until(lambda: recorder.poll().refused > 0)
    os.kill(recorder.writer_pid, signal.SIGKILL)
    following = kept_going(recorder, 52, lambda stats: stats.writer_deaths == 1)
    assert "signal 9" in recorder.poll().last_error
    following = kept_going(recorder, following, lambda stats: not stats.fault)
    final = recorder.close()
    assert (final.writer_deaths, final.refused) == (1, 1)
    assert recorder.path == path.with_name("run.part2.mcap")
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == [*range(1, 51), *range(52, following)]
    with open_log(recorder.path) as log:
        assert (log.metadata.part, log.summary().missing_ticks) == (2, 0)


def test_a_writer_that_was_asked_to_end_by_somebody_else_is_replaced(path, recorder):
    drive(recorder, 1, 5)
    os.kill(recorder.writer_pid, signal.SIGTERM)
    following = kept_going(recorder, 6, lambda stats: stats.writer_deaths == 1)
    assert "ended by another program" in recorder.poll().last_error
    following = kept_going(recorder, following, lambda stats: not stats.fault)
    recorder.close()
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, following))
    with open_log(path) as log:
        assert (log.complete, log.summary().ended) == (True, False)


def test_a_writer_that_says_it_has_failed_ends_no_fault(path, recorder):
    drive(recorder, 1, 5)
    shutil.rmtree(path.parent)
    path.parent.write_text("in the way")
    seen = []
    # Polled as fast as can be, so that each writer's last words are read before its hanging up.
    wait_until(lambda: seen.append(recorder.poll()) or seen[-1].writer_deaths >= 4)
    faults = [stats.fault for stats in seen]
    assert all(faults[faults.index(next(filter(None, faults))) :])
    recorder.close()


def test_close_waits_no_longer_than_asked_and_the_writer_finishes_by_itself(path, recorder):
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


def test_close_twice_and_put_after_close_do_no_harm(path, recorder):
    drive(recorder, 1, 3)
    stats = recorder.close()
    recorder.put(1, tick(4))
    assert recorder.close() == stats
    assert recorded_ticks(path) == [1, 2, 3]


def test_no_process_no_thread_and_no_file_is_left_behind(recorder, runtime_root):
    threads = len(os.listdir("/proc/self/task"))
    processes = (recorder.writer_pid, recorder.keeper_pid)
    recorder.close()
    wait_until(lambda: not any(map(alive, processes)))
    assert list(runtime_root.iterdir()) == []
    assert len(os.listdir("/proc/self/task")) <= threads


@pytest.mark.thorough
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
    with pytest.raises(LogError, match=r"run.mcap: cannot be created \(File exists\); give another path with --log"):
        ProcessRecorder(recording(path))
    assert path.read_text(encoding="utf-8") == "precious"


def test_a_directory_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(LogError, match=r"file.*cannot be created"):
        ProcessRecorder(recording(tmp_path / "file" / "run.mcap"))


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
    # Of several looks the best: between the clocks of one the host may pause.
    assert min(abs(time.monotonic_ns() + wall_offset_ns() - time.time_ns()) for _ in range(20)) < 10**8
