"""What these functions change is the whole process, so each test looks at a process of its own."""

import json
import os
import subprocess
import sys

import pytest

from disco_hw.processes import can_lock_memory, can_use_fifo, stolen_ms

FIFO_ALLOWED = pytest.mark.skipif(not can_use_fifo(), reason="this user may not use SCHED_FIFO")
REPORT = """
import gc, json, os, sys, threading
def locked_kib():
    return int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmLck")))
def report(steps, **more):
    print(json.dumps({
        "steps": [[step.name, step.done, str(step)] for step in steps],
        "policy": os.sched_getscheduler(0), "priority": os.sched_getparam(0).sched_priority,
        "gc": gc.isenabled(), "frozen": gc.get_freeze_count(), "switch_s": sys.getswitchinterval(),
        "locked_kib": locked_kib(), **more}))
"""
AS_NOBODY = "import os; os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"


def run(script, **environment):
    result = subprocess.run(
        [sys.executable, "-c", REPORT + script],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@FIFO_ALLOWED
@pytest.mark.skipif(not can_lock_memory(), reason="this user may not lock memory")
def test_everything_allowed_is_done_and_said():
    seen = run("from disco_hw import processes\nreport(processes.enter_real_time(80))")
    assert all(done for _, done, _ in seen["steps"])
    assert [name for name, _, _ in seen["steps"]] == ["interpreter", "garbage collector", "memory", "scheduler"]
    assert (seen["policy"], seen["priority"]) == (os.SCHED_FIFO, 70)
    assert seen["locked_kib"] > 1000
    assert seen["gc"] is False
    assert seen["frozen"] > 1000
    assert seen["switch_s"] == pytest.approx(0.0005)


@FIFO_ALLOWED
def test_threads_made_later_inherit_and_the_loop_thread_goes_above_them():
    seen = run("""
from disco_hw import processes
steps = processes.enter_real_time(80)
inherited = []
thread = threading.Thread(target=lambda: inherited.append(os.sched_getparam(0).sched_priority))
thread.start(); thread.join()
report([*steps, processes.raise_loop_thread(80)], inherited=inherited)
""")
    assert seen["inherited"] == [70]
    assert seen["priority"] == 80


@FIFO_ALLOWED
@pytest.mark.parametrize("priority", [1, 5])
def test_a_low_priority_still_makes_a_valid_one_for_the_threads(priority):
    seen = run(f"from disco_hw import processes\nreport(processes.enter_real_time({priority}))")
    assert (seen["policy"], seen["priority"]) == (os.SCHED_FIFO, 1)


def test_priority_zero_leaves_scheduler_and_memory_alone_and_says_so():
    seen = run("from disco_hw import processes\nreport(processes.enter_real_time(0))")
    assert seen["policy"] == os.SCHED_OTHER
    assert seen["locked_kib"] == 0
    assert seen["steps"][-1][1:] == [False, "scheduler: unchanged, because daemon.realtime_priority is 0"]


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root to become another user")
def test_what_is_refused_is_said_with_the_remedy_and_the_rest_is_still_done():
    script = """
import resource
from disco_hw import processes
resource.setrlimit(resource.RLIMIT_MEMLOCK, (8 << 20, 8 << 20))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
"""
    able = "[processes.can_use_fifo(), processes.can_lock_memory()]"
    ending = f"report([*processes.enter_real_time(80), processes.raise_loop_thread(80)], able={able})"
    seen = run(script + AS_NOBODY + ending)
    texts = {name: text for name, done, text in seen["steps"] if not done}
    assert set(texts) == {"memory", "scheduler", "loop thread"}
    assert "LimitMEMLOCK" in texts["memory"]
    assert "LimitRTPRIO" in texts["scheduler"]
    assert seen["policy"] == os.SCHED_OTHER
    assert seen["locked_kib"] == 0
    assert seen["gc"] is False
    assert seen["able"] == [False, False]


def test_libraries_not_loaded_yet_are_held_to_one_thread_by_the_environment():
    script = "from disco_hw import processes\nprocesses.limit_thread_pools()\n"
    seen = run(script + "report([], environment=dict(os.environ))", OMP_NUM_THREADS="4")
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        assert seen["environment"][name] == "1"


@pytest.mark.thorough
def test_libraries_loaded_already_are_held_to_one_thread_and_still_work():
    script = """
import numba, torch
from disco_hw import processes
numba.set_num_threads(numba.get_num_threads())
processes.limit_thread_pools()
assert numba.njit(lambda x: x + 1)(1) == 2
report([], torch=torch.get_num_threads(), numba=numba.get_num_threads())
"""
    seen = run(script, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="2")
    assert (seen["torch"], seen["numba"]) == (1, 1)


@pytest.mark.parametrize(("line", "expected_ms"), [("cpu  1 2 3 4 5 6 7 45 9 10", 450), ("cpu  1 2 3 4", 0)])
def test_time_that_the_host_took_is_read_from_the_kernels_statistics(tmp_path, line, expected_ms):
    statistics = tmp_path / "stat"
    statistics.write_text(f"{line}\ncpu0 9 9 9 9 9 9 9 9 9 9\n")
    assert stolen_ms(statistics) * os.sysconf("SC_CLK_TCK") == expected_ms * 100


def test_this_machines_statistics_can_be_read():
    assert stolen_ms() >= 0
