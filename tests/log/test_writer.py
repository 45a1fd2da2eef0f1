"""The writer as a process, with real signals and a disk that is really full."""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from disco_hw.log import writer
from disco_hw.log.errors import LogError
from disco_hw.log.link import EXIT_CANNOT_CREATE, EXIT_CANNOT_WRITE
from disco_hw.log.reader import open_log
from disco_hw.log.recorder import ProcessRecorder
from tests.log.processes import RecordingProcess, alive, drive, recording, size, wait_until
from tools.log_samples import start

SECOND_NS = 1_000_000_000


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


def ticks_of(path):
    with open_log(path) as log:
        return [entry.tick for entry in log.records(("/loop",))]


def test_a_killed_writer_loses_no_more_than_what_came_since_the_last_flush(path):
    recorder = ProcessRecorder(recording(path, flush_s=0.05))
    drive(recorder, 1, 200, period_s=0.002)
    wait_until(lambda: recorder.poll().written > 500)
    written = recorder.poll().written
    os.kill(recorder.writer_pid, signal.SIGKILL)
    wait_until(lambda: not recorder.poll().writer_alive)
    recorder.close()
    with open_log(path) as log:
        assert not log.complete
        assert "the end is missing" in log.damage[-1]
        assert sum(log.counts.values()) >= written
    assert ticks_of(path) == list(range(1, len(ticks_of(path)) + 1))


def test_when_the_recording_process_is_killed_the_file_is_finished(path):
    with RecordingProcess(path) as recording_process:
        wait_until(lambda: size(path) > 40_000)
        recording_process.process.kill()
        killed = time.monotonic()
        wait_until(lambda: not alive(recording_process.writer_pid))
        assert time.monotonic() - killed < 10.0
    with open_log(path) as log:
        assert log.complete
        assert log.summary().missing_ticks == 0
    assert len(ticks_of(path)) > 20


def test_what_was_still_on_its_way_when_the_recording_process_was_killed_is_not_lost(path):
    with RecordingProcess(path, 6, 7) as recording_process:
        wait_until(lambda: size(path) > 2000)
        os.kill(recording_process.writer_pid, signal.SIGSTOP)
        time.sleep(1.0)
        recording_process.process.kill()
        last_put = int(recording_process.process.stdout.readlines()[-1])
        os.kill(recording_process.writer_pid, signal.SIGCONT)
        wait_until(lambda: not alive(recording_process.writer_pid))
    assert ticks_of(path)[-1] > last_put - 20


def test_nothing_is_left_in_the_runtime_directory_of_a_killed_process(path, runtime_root):
    with RecordingProcess(path) as recording_process:
        wait_until(lambda: size(path) > 0)
        recording_process.process.kill()
        wait_until(lambda: not alive(recording_process.writer_pid))
    assert list(runtime_root.iterdir()) == []


def test_when_both_are_killed_the_file_still_reads(path):
    with RecordingProcess(path) as recording_process:
        wait_until(lambda: size(path) > 40_000)
        os.kill(recording_process.writer_pid, signal.SIGKILL)
        recording_process.process.kill()
        wait_until(lambda: not alive(recording_process.writer_pid))
    assert len(ticks_of(path)) > 20


def test_an_interrupt_is_not_for_the_writer(path):
    recorder = ProcessRecorder(recording(path))
    drive(recorder, 1, 5)
    wait_until(lambda: recorder.poll().written > 0)
    os.kill(recorder.writer_pid, signal.SIGINT)
    drive(recorder, 6, 5, period_s=0.01)
    assert recorder.close().writer_deaths == 0
    assert ticks_of(path) == list(range(1, 11))


def test_what_comes_after_a_termination_is_still_recorded(path):
    recorder = ProcessRecorder(recording(path))
    drive(recorder, 1, 5)
    wait_until(lambda: recorder.poll().written > 0)
    os.kill(recorder.writer_pid, signal.SIGTERM)
    drive(recorder, 6, 50, period_s=0.01)
    assert recorder.close().writer_deaths == 0
    assert ticks_of(path) == list(range(1, 56))


def test_the_writer_has_a_session_of_its_own(path):
    recorder = ProcessRecorder(recording(path))
    assert os.getsid(recorder.writer_pid) != os.getsid(0)
    assert os.getpgid(recorder.writer_pid) != os.getpgid(0)
    recorder.close()


def fill(recorder):
    """Record until the writer gives up."""
    first = 1
    while recorder.poll().writer_alive:
        drive(recorder, first, 20, period_s=0.001)
        first += 20
        assert first < 50_000
    return recorder.poll()


def check_after_full_disk(path, stats, words):
    assert stats.writer_deaths == 1
    assert words in stats.last_error
    with open_log(path) as log:
        assert log.damage == ("the end is missing: the writer was killed or is still at work, or the file was cut",)
    assert len(ticks_of(path)) > 20


def test_a_full_disk_ends_the_log_and_nothing_else(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=160k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"a small file system cannot be mounted here: {mounted.stderr.decode().strip()}")
    try:
        recorder = ProcessRecorder(recording(disk / "run.mcap"))
        stats = fill(recorder)
        check_after_full_disk(disk / "run.mcap", stats, "No space left on device")
        recorder.close()
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_file_that_may_not_grow_ends_the_log_and_nothing_else(path):
    recorder = ProcessRecorder(recording(path))
    resource.prlimit(recorder.writer_pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
    stats = fill(recorder)
    check_after_full_disk(path, stats, "File too large")
    recorder.close()


def run_writer(tmp_path, **changes):
    import msgspec

    start_file = tmp_path / "start"
    start_file.write_bytes(msgspec.msgpack.encode(start(**changes)))
    return subprocess.run(
        [sys.executable, "-m", "disco_hw.log.writer", str(start_file)],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        cwd=Path(__file__).parents[2],
    )


def test_a_file_that_cannot_be_created_is_an_exit_status_and_a_line(tmp_path, runtime_root):
    taken = tmp_path / "taken.mcap"
    taken.write_text("precious", encoding="utf-8")
    for target in (taken, tmp_path / "none" / "run.mcap"):
        done = run_writer(tmp_path, path=target, endpoint=f"ipc://{runtime_root}/socket")
        assert done.returncode == EXIT_CANNOT_CREATE
        assert f"{target}: cannot be created" in done.stderr
        assert "Traceback" not in done.stderr
        assert '"failed"' in done.stdout
    assert taken.read_text(encoding="utf-8") == "precious"


def test_a_disk_full_from_the_start_is_an_exit_status_and_a_line(tmp_path, runtime_root):
    code = (
        "import resource, runpy, sys;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0));"
        "runpy.run_module('disco_hw.log.writer', run_name='__main__', alter_sys=True)"
    )
    import msgspec

    start_file = tmp_path / "start"
    start_file.write_bytes(msgspec.msgpack.encode(start(tmp_path / "r.mcap", endpoint=f"ipc://{runtime_root}/socket")))
    done = subprocess.run(
        [sys.executable, "-c", code, str(start_file)], capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == EXIT_CANNOT_WRITE
    assert "cannot be written (File too large)" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("arguments", [[], ["/nonexistent/start"], [__file__]])
def test_wrong_usage_is_one_line(arguments):
    command = [sys.executable, "-m", "disco_hw.log.writer", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_deadlines():
    deadlines = writer.Deadlines(start(parent_pid=7, silence_s=10.0, grace_s=3.0), 0)
    assert not deadlines.orphaned(7)
    assert deadlines.orphaned(1)
    assert not deadlines.passed(10 * SECOND_NS)
    assert deadlines.passed(10 * SECOND_NS + 1)
    deadlines.heard(9 * SECOND_NS)
    assert not deadlines.passed(19 * SECOND_NS)
    deadlines.terminate(12 * SECOND_NS)
    deadlines.heard(14 * SECOND_NS)
    deadlines.terminate(14 * SECOND_NS)
    assert not deadlines.passed(15 * SECOND_NS)
    assert deadlines.passed(15 * SECOND_NS + 1)


def test_a_status_nobody_reads_costs_nothing():
    read, write = os.pipe()
    line = writer.StatusLine(write)
    status = writer.WriterStatus("recording", 1, 2, 3)
    for _ in range(10_000):
        line.send(status)
    os.close(read)
    line.send(status)
    os.close(write)


def test_a_half_written_end_is_cut_off(path):
    file = writer.LogFile(path)
    file.write(b"whole")
    resource.prlimit(0, resource.RLIMIT_FSIZE, (8, resource.RLIM_INFINITY))
    try:
        with pytest.raises(OSError, match="File too large"):
            file.write(b"half-written")
    finally:
        resource.prlimit(0, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    assert path.read_bytes() == b"wholehal"
    file.cut_to_whole()
    assert path.read_bytes() == b"whole"
    assert file.tell() == 5
    file.close()
    with pytest.raises(FileExistsError):
        writer.LogFile(path)


def test_the_errors_of_a_log_are_those_of_bad_input():
    from disco_hw.errors import InputError

    assert issubclass(LogError, InputError)
