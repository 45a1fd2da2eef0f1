"""The recorder broken while the robot drives: the log is begun anew, and nobody is left to believe that all is well."""

from __future__ import annotations

import os
import re
import shutil
import signal
import time
from pathlib import Path

import pytest

from disco_hw.errors import WorkError
from disco_hw.experiments import READY_TIMEOUT_S
from disco_hw.log.log_command import info
from disco_hw.log.reader import open_log
from tests.drivers.waiting import free_port, wait_until
from tests.hil.stack import STATIONARY_RAD_S, disco_here
from tests.log.processes import SmallDisk, recorded_ticks
from tools.stack import Stack, running_stack

pytestmark = pytest.mark.hil


def children(pid: int) -> list[int]:
    return [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]


def named(pid: int, module: str) -> bool:
    try:
        return module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    except FileNotFoundError:
        return False


def keeper_of(stack: Stack) -> int:
    """The process that starts log writers."""
    (keeper,) = [pid for pid in children(stack.daemon.process.pid) if named(pid, "disco_hw.log.writer")]
    return keeper


def writer_of(stack: Stack) -> int:
    return children(keeper_of(stack))[-1]


def wait_for_recording(stack: Stack, deaths: int) -> None:
    stack.operator.wait_until(
        f"recording again after {deaths} ends",
        lambda status: status["recorder"]["writer_deaths"] >= deaths and not status["recorder"]["fault"],
        20.0,
    )


def events_in(path: Path) -> list[str]:
    with open_log(path) as log:
        return [entry.record.text for entry in log.records(("/event",)) if entry.record.code == "recording"]


@pytest.mark.thorough
def test_a_recorder_frozen_killed_and_deleted_on_the_way_is_reported_counted_and_replaced(tmp_path):
    first, second, third, fourth = (tmp_path / f"run{part}.mcap" for part in ("", ".part2", ".part3", ".part4"))
    with running_stack(tmp_path) as stack:
        stack.drive(until_rad_s=2.0)
        os.kill(writer_of(stack), signal.SIGSTOP)
        frozen = stack.operator.wait_until("report of the fault", lambda status: status["recorder"]["fault"], 10.0)
        assert "the log writer has not answered for" in frozen["recorder"]["fault"]
        code, text = disco_here("ctl", str(stack.robot_file), "status")
        assert (code, "recording " in text) == (0, True)
        wait_for_recording(stack, 1)
        os.kill(writer_of(stack), signal.SIGKILL)
        wait_for_recording(stack, 2)
        deleted = third.open("rb")
        third.unlink()
        wait_for_recording(stack, 3)
        status = stack.operator.status()
        assert status["state"] == "ARMED"
        recorder = status["recorder"]
        assert recorder["path"] == str(fourth)
        assert recorder["dropped_ticks"] == 0
        assert recorder["ticks"] == sum(recorder[f"{where}_ticks"] for where in ("delivered", "waiting", "lost"))
        stack.operator.request("quit")
        assert stack.daemon.process.wait(60.0) == 1
        ended_s = time.monotonic()
        rows = stack.truth()
        output = (tmp_path / "daemon.txt").read_text()
    assert next(row for row in reversed(rows) if row.t_s < ended_s).fastest < STATIONARY_RAD_S
    for fragment in (
        "has not answered for",
        "was stopped",
        "signal 9",
        "deleted while it was being written",
        "goes on in",
    ):
        assert any(line.startswith("recording: ") and fragment in line for line in output.splitlines()), fragment
    assert not third.exists()
    # A killed writer may have written more than it had confirmed: those ticks are in the next file, too.
    kept = sorted({*recorded_ticks(first), *recorded_ticks(second)})
    assert kept == list(range(1, kept[-1] + 1)), "a tick is missing"
    with deleted:
        unlinked = Path(f"/proc/self/fd/{deleted.fileno()}")
        gone, events_gone = recorded_ticks(unlinked), events_in(unlinked)
    with open_log(fourth) as log:
        assert log.metadata.continues_sequence == gone[-1]
        assert log.metadata.continues == str(third)
        summary = log.summary()
    assert (summary.ended, summary.missing_ticks) == (True, 0)
    assert recorded_ticks(fourth)[0] == gone[-1] + 1
    assert gone[0] <= kept[-1] + 1
    assert f"{len(gone)} lost with a deleted file" in output
    assert f"recording: {len(gone)} of " in output
    # What the killed writer had not confirmed was given to the third.
    reported = [*events_in(first), *events_in(second), *events_gone, *events_in(fourth)]
    assert any("has not answered" in text for text in reported)
    assert any("deleted" in text for text in reported)
    assert "ended properly" not in info(first, as_json=False)
    assert f"continues {first}" in info(second, as_json=False)


@pytest.mark.thorough
def test_where_nothing_can_be_recorded_arming_is_refused_unless_that_is_asked_for(tmp_path):
    logs = tmp_path / "logs"
    with running_stack(tmp_path, run_arguments=("--log", str(logs / "run.mcap"))) as stack:
        stack.operator.wait_for("READY", READY_TIMEOUT_S)
        shutil.rmtree(logs)
        logs.write_text("in the way")
        stack.operator.wait_until("report of the fault", lambda status: status["recorder"]["fault"], 10.0)
        with pytest.raises(WorkError, match=r"nothing is being recorded: .*; correct that, or arm with --unrecorded"):
            stack.operator.request("arm")
        code, text = disco_here("ctl", str(stack.robot_file), "arm")
        assert code == 1
        assert "refused: nothing is being recorded" in text
        assert stack.operator.status()["state"] == "READY"
        code, text = disco_here("ctl", str(stack.robot_file), "status")
        assert "RECORDING: nothing is being recorded" in text
        code, text = disco_here("ctl", str(stack.robot_file), "arm", "--unrecorded")
        assert (code, text.strip()) == (0, "arming")
        stack.operator.wait_for("ARMED", 5.0)
        logs.unlink()
        wait_for_recording(stack, 1)
        stack.operator.request("disarm")
        stack.operator.wait_for("READY", 5.0)
        stack.operator.request("arm")


@pytest.mark.thorough
def test_a_keeper_frozen_or_killed_is_made_again_while_disarmed(tmp_path):
    with running_stack(tmp_path) as stack:
        stack.operator.wait_for("READY", READY_TIMEOUT_S)
        for deaths, how in enumerate((signal.SIGSTOP, signal.SIGKILL), 1):
            keeper, writer = keeper_of(stack), writer_of(stack)
            os.kill(keeper, how)
            os.kill(writer, signal.SIGKILL)
            wait_for_recording(stack, deaths)
            assert keeper_of(stack) != keeper
        stack.operator.request("arm")


@pytest.mark.long
def test_a_drive_that_ends_with_a_full_disk_says_which_ticks_are_lost_and_exits_with_1(tmp_path):
    with SmallDisk(tmp_path, 4160) as disk:
        (disk / "filler").write_bytes(bytes(4040 * 1024))
        with running_stack(tmp_path, run_arguments=("--log", str(disk / "run.mcap"))) as stack:
            stack.operator.wait_until("disk full", lambda status: status["recorder"]["fault"], READY_TIMEOUT_S)
            stack.daemon.process.send_signal(signal.SIGTERM)
            assert stack.daemon.process.wait(60.0) == 1
            output = (tmp_path / "daemon.txt").read_text()
        last = output[output.index("SIGTERM") :]
        assert "Traceback" not in output
        assert re.search(r"recording: [1-9]\d* of \d+ ticks are not in the log: .*No space left on device", last)
        assert "stop: recorder: " in last
        assert "free space on its disk before the next drive" in last
        # The attempts that failed name a file that could not be made; what is left to look at must be there.
        named_files = re.findall(r"\S+\.mcap", "".join(line for line in last.splitlines() if line.startswith("log: ")))
        assert named_files
        assert all(Path(name).exists() for name in named_files), last
        assert recorded_ticks(disk / "run.mcap")


@pytest.mark.long
def test_a_page_that_is_killed_is_started_again_and_its_end_is_in_the_log(tmp_path):
    page = ("--view", "--port", str(free_port()))
    with running_stack(tmp_path, run_arguments=page) as stack:

        def pages() -> list[int]:
            return [pid for pid in children(stack.daemon.process.pid) if named(pid, "disco_hw.viewer.commands")]

        stack.operator.wait_for("READY", READY_TIMEOUT_S)
        (first,) = pages()
        os.kill(first, signal.SIGKILL)
        # One look decides: between two of them the page may die, before the daemon has noticed.
        wait_until(lambda: set(pages()) - {first}, 60.0)
        stack.operator.request("quit")
        assert stack.daemon.process.wait(60.0) == 0
        assert "page: the page was ended by SIGKILL; it is started again" in stack.daemon.output_lines()
    with open_log(tmp_path / "run.mcap") as log:
        events = [entry.record for entry in log.records(("/event",)) if entry.record.code == "page"]
    assert [(event.level, event.text) for event in events] == [
        ("warning", "the page was ended by SIGKILL; it is started again")
    ]
