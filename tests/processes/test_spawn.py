import os
import sys
import threading

import pytest

from disco_hw.errors import LogError
from disco_hw.processes import spawn_at_normal_priority

PRINT_SCHEDULING = "import os; print(os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0))"


def child_scheduling():
    process = spawn_at_normal_priority([sys.executable, "-c", PRINT_SCHEDULING])
    process.wait(20)
    policy, nice = process.stdout.read().split()
    process.stdout.close()
    return int(policy), int(nice)


def in_thread(work):
    result = []
    thread = threading.Thread(target=lambda: result.append(work()))
    thread.start()
    thread.join()
    return result[0]


def test_the_child_of_a_real_time_thread_runs_at_normal_priority():
    def work():
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        except PermissionError:
            return None
        child = child_scheduling()
        return child, os.sched_getscheduler(0)

    found = in_thread(work)
    if found is None:
        pytest.skip("no right to use SCHED_FIFO here")
    (policy, _), thread_policy = found
    assert policy == os.SCHED_OTHER
    assert thread_policy == os.SCHED_FIFO


def test_the_child_of_a_favoured_thread_is_not_favoured():
    def work():
        try:
            os.setpriority(os.PRIO_PROCESS, 0, -5)
        except PermissionError:
            return None
        return child_scheduling()

    found = in_thread(work)
    if found is None:
        pytest.skip("no right to raise the priority here")
    assert found[1] == 0


def test_its_output_does_not_block_the_reader():
    process = spawn_at_normal_priority([sys.executable, "-c", "import time; time.sleep(30)"])
    with pytest.raises(BlockingIOError):
        os.read(process.stdout.fileno(), 10)
    assert os.getsid(process.pid) == process.pid
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_program_that_is_not_there_is_named():
    with pytest.raises(LogError, match="/nonexistent/python"):
        spawn_at_normal_priority(["/nonexistent/python"])
