"""Which failures of a test in real time are tried again: runs of pytest with a host that takes what it is told to."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.hil.conftest import watcher

# The host takes its time between the third look at it and the fourth, however long these take to come. What else stops
# the machine meanwhile is not to count.
CONFTEST = """
from disco_hw import processes
from tests.hil import conftest

def stolen_ms():
    processes.looks.append({stolen_ms} if len(processes.looks) > 2 else 0)
    return processes.looks[-1]

processes.looks, processes.stolen_ms = [], stolen_ms
if {stolen_ms}:
    conftest.watcher = lambda: None
pytest_runtest_protocol = conftest.pytest_runtest_protocol
"""
# Stopped for a while, the watchers tell what they do when nobody is run. They begin once they have their priority.
PAUSE = """
import os, signal

def hold_up():
    tasks = Path(f"/proc/{os.getpid()}/task")
    children = [pid for task in tasks.iterdir() for pid in (task / "children").read_text().split()]
    watchers = [int(pid) for pid in children if "watch" in Path(f"/proc/{pid}/cmdline").read_text()]
    while not all(os.sched_getscheduler(pid) == os.SCHED_FIFO for pid in watchers):
        time.sleep(0.01)
    for how in (signal.SIGCONT, signal.SIGSTOP, signal.SIGCONT):
        for pid in watchers:
            os.kill(pid, how)
        time.sleep(0.2)
"""
TEST = """
import time
from pathlib import Path
from disco_hw import processes

def wait_for_looks():
    while len(processes.looks) < 6:
        time.sleep(0.01)

def test_in_real_time(tmp_path):
    tries = Path(__file__).with_name("tries")
    tries.write_text((tries.read_text() if tries.exists() else "") + "x")
    {happens}()
    assert tries.read_text() == "x" * {passes_at}
"""


def run(folder):
    command = [sys.executable, "-m", "pytest", "-c", "/dev/null", f"--rootdir={folder}", "-p", "no:cacheprovider"]
    return subprocess.run(
        [*command, str(folder)], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
    )


@pytest.mark.parametrize(
    ("stolen_ms", "passes_at", "tries", "code"),
    [
        (120, 2, 2, 0),
        *(pytest.param(*case, marks=pytest.mark.thorough) for case in ((120, 3, 2, 1), (90, 2, 1, 1), (120, 1, 1, 0))),
    ],
)
def test_a_failure_is_tried_once_more_where_the_host_took_the_processors(tmp_path, stolen_ms, passes_at, tries, code):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(stolen_ms=stolen_ms))
    (tmp_path / "test_it.py").write_text(TEST.format(passes_at=passes_at, happens="wait_for_looks"))
    result = run(tmp_path)
    assert result.returncode == code, result.stdout + result.stderr
    assert (tmp_path / "tries").read_text() == "x" * tries
    assert ("tried once more: this machine ran nothing for" in result.stdout) is (tries == 2)


@pytest.mark.skipif(watcher() is None, reason="needs cc and the right to SCHED_FIFO")
def test_so_is_one_during_which_a_processor_ran_nobody(tmp_path):
    (tmp_path / "conftest.py").write_text(CONFTEST.format(stolen_ms=0))
    (tmp_path / "test_it.py").write_text(TEST.format(passes_at=2, happens="hold_up") + PAUSE)
    result = run(tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "tries").read_text() == "xx"
