"""Which failures of a test in real time are tried again: runs of pytest with a host that takes what it is told to."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.hil.conftest import watcher

CONFTEST = """
import threading, time
from disco_hw import processes
processes.stolen_ms = lambda: {taken_ms} if time.monotonic() > BEGAN_S + 0.3 else 0
BEGAN_S = time.monotonic()
from tests.hil.conftest import pytest_runtest_protocol
"""
# Stopped for a while, the watchers tell what they do when nobody is run.
PAUSE = """
import os, signal
from pathlib import Path

def hold_up():
    tasks = Path(f"/proc/{os.getpid()}/task")
    children = [pid for task in tasks.iterdir() for pid in (task / "children").read_text().split()]
    watchers = [int(pid) for pid in children if "watch" in Path(f"/proc/{pid}/cmdline").read_text()]
    for how in (signal.SIGSTOP, signal.SIGCONT):
        for pid in watchers:
            os.kill(pid, how)
        time.sleep(0.2)
"""
TEST = """
import time
from pathlib import Path

def test_in_real_time(tmp_path):
    tries = Path(__file__).with_name("tries")
    tries.write_text((tries.read_text() if tries.exists() else "") + "x")
    time.sleep(0.5)
    assert tries.read_text() == "x" * {passes_at}
"""


def run(folder):
    command = [sys.executable, "-m", "pytest", "-c", "/dev/null", f"--rootdir={folder}", "-p", "no:cacheprovider"]
    return subprocess.run(
        [*command, str(folder)], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
    )


@pytest.mark.parametrize(
    ("taken_ms", "passes_at", "tries", "code"),
    [
        (120, 2, 2, 0),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in ((120, 3, 2, 1), (90, 2, 1, 1), (120, 1, 1, 0))),
    ],
)
def test_a_failure_is_tried_once_more_where_the_host_took_the_processors(tmp_path, taken_ms, passes_at, tries, code):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(taken_ms=taken_ms))
    (tmp_path / "test_it.py").write_text(TEST.format(passes_at=passes_at))
    result = run(tmp_path)
    assert result.returncode == code, result.stdout + result.stderr
    assert (tmp_path / "tries").read_text() == "x" * tries
    assert ("tried once more: this machine ran nothing for" in result.stdout) is (tries == 2)


@pytest.mark.skipif(watcher() is None, reason="needs cc and the right to SCHED_FIFO")
def test_so_is_one_during_which_a_processor_ran_nobody(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(taken_ms=0))
    test = TEST.format(passes_at=2).replace("time.sleep(0.5)", "hold_up()")
    (tmp_path / "test_it.py").write_text(PAUSE + test)
    result = run(tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "tries").read_text() == "xx"
