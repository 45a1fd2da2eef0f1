"""The writer as a process, with real signals and a disk that is really full."""

import errno
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from itertools import count
from pathlib import Path

import msgspec
import pytest

from disco_hw.errors import InputError, LogError
from disco_hw.log import writer
from disco_hw.log.log_command import info
from disco_hw.log.process_recorder import ProcessRecorder
from disco_hw.log.reader import open_log
from disco_hw.log.writer_link import KeeperLink
from tests.log.processes import (
    RecordingProcess,
    SmallDisk,
    alive,
    drive,
    files_of_at_most,
    recorded_ticks,
    recording,
    size,
    wait_until,
)
from tools.log_samples import start


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def recorder(path, request):
    request.getfixturevalue("forked_keepers")
    return ProcessRecorder(recording(path))


@pytest.mark.usefixtures("forked_keepers")
def test_the_writers_process_is_known_from_the_start(path, monkeypatch):
    """Even if the keeper is heard long after the writer: who sends a signal to process 0 sends it to itself."""
    read, calls = KeeperLink.read, count()
    monkeypatch.setattr(KeeperLink, "read", lambda self: read(self) if next(calls) > 20 else None)
    recorder = ProcessRecorder(recording(path))
    assert recorder.writer_pid
    assert alive(recorder.writer_pid)
    recorder.close()
    assert recorder.writer_pid is None


def test_a_killed_writer_loses_no_more_than_what_came_since_the_last_flush(path, recorder):
    drive(recorder, 1, 200, period_s=0.002)
    wait_until(lambda: recorder.poll().delivered_ticks > 100)
    written = recorder.poll().delivered_ticks * 7
    os.kill(recorder.writer_pid, signal.SIGKILL)
    drive(recorder, 201, 10)
    wait_until(lambda: recorder.poll().writer_deaths == 1)
    recorder.close()
    with open_log(path) as log:
        assert not log.complete
        assert "the end is missing" in log.damage[-1]
        assert sum(log.counts.values()) >= written
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, 211))


def test_when_the_recording_process_is_killed_the_file_is_finished_and_nothing_else_is_left(path, runtime_root):
    with RecordingProcess(path) as recording_process:
        wait_until(lambda: size(path) > 40_000)
        recording_process.process.kill()
        killed = time.monotonic()
        wait_until(lambda: not alive(recording_process.writer_pid))
        assert time.monotonic() - killed < 10.0
    assert list(runtime_root.iterdir()) == []
    with open_log(path) as log:
        assert log.complete
        assert log.ending is None
        assert (log.summary().missing_ticks, log.summary().ended) == (0, False)
    assert "nothing recorded after" in info(path, as_json=False)
    assert len(recorded_ticks(path)) > 20


def test_what_was_still_on_its_way_when_the_recording_process_was_killed_is_not_lost(path):
    with RecordingProcess(path, 6, 7) as recording_process:
        wait_until(lambda: size(path) > 2000)
        os.kill(recording_process.writer_pid, signal.SIGSTOP)
        # Shorter by far than a silent writer is put up with, and many times what may be lost.
        time.sleep(0.3)
        recording_process.process.kill()
        last_recorded = int(recording_process.said.readlines()[-1])
        os.kill(recording_process.writer_pid, signal.SIGCONT)
        wait_until(lambda: not alive(recording_process.writer_pid))
    assert recorded_ticks(path)[-1] > last_recorded - 20


def test_when_both_are_killed_the_file_still_reads(path):
    with RecordingProcess(path) as recording_process:
        wait_until(lambda: size(path) > 40_000)
        os.kill(recording_process.writer_pid, signal.SIGKILL)
        recording_process.process.kill()
        wait_until(lambda: not alive(recording_process.writer_pid))
    assert len(recorded_ticks(path)) > 20


@pytest.mark.parametrize(("sent", "ticks"), [(signal.SIGINT, 5), (signal.SIGTERM, 50)])
def test_what_comes_after_an_interrupt_or_a_termination_is_still_recorded(path, recorder, sent, ticks):
    drive(recorder, 1, 5)
    wait_until(lambda: recorder.poll().written > 0)
    os.kill(recorder.writer_pid, sent)
    drive(recorder, 6, ticks, period_s=0.01)
    assert recorder.close().writer_deaths == 0
    assert recorded_ticks(path) == list(range(1, 6 + ticks))


def test_the_writer_has_a_session_of_its_own_and_its_path_may_be_relative(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    recorder = ProcessRecorder(recording(Path("run.mcap")))
    assert os.getsid(recorder.writer_pid) != os.getsid(0)
    assert os.getpgid(recorder.writer_pid) != os.getpgid(0)
    drive(recorder, 1, 2)
    recorder.close()
    assert recorded_ticks(tmp_path / "run.mcap") == [1, 2]


def fill(recorder):
    """Record until the writer gives up; returns the counters and how many ticks were given.

    No more wait than the queue holds, however late a busy computer lets the writer run: none is dropped.
    """
    first = 1
    while not (stats := recorder.poll()).writer_deaths:
        if stats.waiting_ticks > 800:
            time.sleep(0.001)
            continue
        drive(recorder, first, 20, period_s=0.001)
        first += 20
        assert first < 50_000
    return stats, first - 1


def check_after_full_disk(path, stats, message):
    assert stats.writer_deaths >= 1
    assert message in stats.last_error
    assert "nothing is being recorded" in stats.fault
    with open_log(path) as log:
        assert log.damage == ("the end is missing: the writer was killed or is still at work, or the file was cut",)
    assert len(recorded_ticks(path)) > 20


@pytest.fixture
def full_disk(tmp_path, request):
    """A full disk, a recorder whose writer has met it, its counters by then, and how many ticks were given."""
    request.getfixturevalue("forked_keepers")
    with SmallDisk(tmp_path, 4160) as disk:
        # With 120 kB beside it; without it there is room for all that a slow machine has waiting by then.
        (disk / "filler").write_bytes(bytes(4040 * 1024))
        recorder = ProcessRecorder(recording(disk / "run.mcap"))
        yield disk, recorder, *fill(recorder)


def test_a_full_disk_ends_the_log_and_with_room_again_another_begins(full_disk):
    disk, recorder, stats, given = full_disk
    check_after_full_disk(disk / "run.mcap", stats, "No space left on device")
    wait_until(lambda: recorder.poll().writer_deaths > 2)
    # It tries again and again, and leaves nothing lying about when that fails.
    assert sum(entry.suffix == ".mcap" for entry in disk.iterdir()) <= 2
    assert len([line for line in recorder.new_messages() if "No space" in line]) <= 3
    (disk / "filler").unlink()
    wait_until(lambda: not recorder.poll().fault and recorder.poll().waiting_ticks == 0)
    final = recorder.close()
    assert final.ticks + final.dropped_ticks == given
    assert final.delivered_ticks == final.ticks
    assert recorder.path == disk / "run.part2.mcap"
    assert recorded_ticks(disk / "run.mcap") + recorded_ticks(recorder.path) == list(range(1, final.ticks + 1))


def test_the_last_words_with_a_full_disk_count_the_ticks_that_are_lost_and_name_files_that_exist(full_disk):
    _, recorder, _, given = full_disk
    recorder.new_messages()
    final = recorder.close(1.0)
    assert final.waiting_ticks == given - final.delivered_ticks > 0
    messages = recorder.new_messages()
    assert f"{final.waiting_ticks} of {given} ticks are not in the log: " in messages[-1]
    assert "No space left on device" in messages[-1]
    assert not [line for line in messages if "goes on" in line]
    assert final.fault == messages[-1]
    assert Path(final.path).exists()


def test_the_last_words_during_an_attempt_name_a_file_that_stays(full_disk):
    disk, recorder, _, _ = full_disk
    wait_until(lambda: recorder.poll() and recorder.path.name == "run.part2.mcap")
    final = recorder.close(0.0)
    wait_until(lambda: not (disk / "run.part2.mcap").exists())
    assert Path(final.path).exists()


def test_a_disk_with_room_again_at_the_end_loses_nothing_and_the_part_begins_before_it_ends(full_disk):
    disk, recorder, _, given = full_disk
    # The next attempt is seconds away.
    wait_until(lambda: recorder.poll().writer_deaths > 3)
    recorder.new_messages()
    (disk / "filler").unlink()
    final = recorder.close()
    assert (final.delivered_ticks, final.waiting_ticks, final.fault) == (given, 0, "")
    assert recorder.new_messages() == (f"recording goes on in {final.path}",)
    assert recorded_ticks(disk / "run.mcap") + recorded_ticks(Path(final.path)) == list(range(1, given + 1))
    with open_log(Path(final.path)) as log:
        assert log.summary().start < log.summary().end


def test_a_file_that_may_not_grow_is_continued_by_another(path, recorder):
    resource.prlimit(recorder.writer_pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
    stats, given = fill(recorder)
    check_after_full_disk(path, stats, "File too large")
    final = recorder.close()
    assert (final.writer_deaths, final.delivered_ticks) == (1, given)
    assert recorded_ticks(path) + recorded_ticks(recorder.path) == list(range(1, given + 1))


@pytest.mark.usefixtures("forked_keepers")
def test_a_disk_full_from_the_start_is_one_line(tmp_path):
    with SmallDisk(tmp_path, 16) as disk:
        (disk / "filler").write_bytes(bytes(16 * 1024))
        with pytest.raises(LogError, match=r"run\.mcap: cannot be written: No space left on device"):
            ProcessRecorder(recording(disk / "run.mcap"))
        assert [entry.name for entry in disk.iterdir()] == ["filler"]


@pytest.mark.parametrize("arguments", [[], ["1"], ["a", "b"]])
def test_wrong_usage_of_the_keeper_is_one_line(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["writer", *arguments])
    # Else this process would ignore signals from now on.
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert writer.main() == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_a_status_nobody_reads_costs_nothing_and_the_next_that_is_read_is_whole():
    ours, theirs = socket.socketpair()
    line = writer.StatusLine(theirs)
    status = writer.WriterStatus("recording", "x" * 500, 1)
    for _ in range(10_000):
        line.send(status)
    while ours.recv(1 << 20, socket.MSG_DONTWAIT)[-1:] != b"\n":
        line.send(status)
    line.send(status)
    assert msgspec.json.decode(ours.recv(1 << 20).splitlines()[-1], type=writer.WriterStatus) == status
    ours.close()
    line.send(status)
    theirs.close()


def test_where_no_process_can_be_made_the_reason_is_told_in_the_writers_place(path, monkeypatch):
    def fork():
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(writer.os, "fork", fork)
    recorder, keeper = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours, theirs = socket.socketpair()
    request = start(path, part=2)
    with recorder, keeper, ours:
        with theirs:
            socket.send_fds(recorder, [msgspec.msgpack.encode(request)], [theirs.fileno()])
        recorder.shutdown(socket.SHUT_WR)
        writer.keep(keeper, request)
        status = msgspec.json.decode(ours.recv(1 << 16), type=writer.WriterStatus)
        assert (status.state, status.part) == ("failed", 2)
        assert status.error.endswith("no process can be made to write it (Resource temporarily unavailable)")
        assert ours.recv(1) == b""


def test_a_half_written_end_is_cut_off(path):
    file = writer.LogFile(path)
    file.write(b"wh")
    file.write(b"ole")
    file.flush()
    file.write(b"h")
    with files_of_at_most(8), pytest.raises(OSError, match="File too large"):
        file.write(b"alf-written")
    assert path.read_bytes() == b"wholehal"
    file.truncate_to_complete()
    assert path.read_bytes() == b"whole"
    assert file.tell() == 5
    file.close()
    with pytest.raises(FileExistsError):
        writer.LogFile(path)


def test_the_errors_of_a_log_are_those_of_bad_input():
    assert issubclass(LogError, InputError)


@pytest.fixture
def slow_disk(tmp_path, monkeypatch):
    """Let each fsync of the processes that are started now take 2.5 s, as a worn SD card does."""
    source, library = tmp_path / "slow.c", tmp_path / "slow.so"
    source.write_text(
        "#include <sys/syscall.h>\n#include <unistd.h>\n"
        "int fsync(int fd) { usleep(2500000); return (int)syscall(SYS_fsync, fd); }\n",
        encoding="utf-8",
    )
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    monkeypatch.setenv("LD_PRELOAD", str(library))


@pytest.mark.usefixtures("slow_disk")
def test_a_disk_that_takes_seconds_holds_up_no_writer_and_is_reported_once(path):
    recorder = ProcessRecorder(recording(path))
    begin_s, first = time.monotonic(), 1
    while time.monotonic() - begin_s < 7.0:
        drive(recorder, first, 1, period_s=0.05)
        stats = recorder.poll()
        assert (stats.writer_deaths, stats.fault) == (0, "")
        first += 1
    final = recorder.close(10.0)
    assert (final.delivered_ticks, final.waiting_ticks) == (first - 1, 0)
    assert recorded_ticks(path) == list(range(1, first))
    messages = recorder.new_messages()
    assert [line for line in messages if "the disk has been storing the log for 2." not in line] == []
    assert len(messages) == 1
