import os
import sys
import threading

import pytest

from disco_hw.errors import LogError
from disco_hw.processes import spawn_at_normal_priority

WRITE_SCHEDULING = """
import os, sys
with os.fdopen(int(sys.argv[1]), "w") as pipe:
    print(os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), file=pipe)
"""


def child_scheduling():
    reading, writing = os.pipe()
    process = spawn_at_normal_priority([sys.executable, "-c", WRITE_SCHEDULING, str(writing)], pass_fds=(writing,))
    os.close(writing)
    with os.fdopen(reading) as pipe:
        policy, nice = pipe.read().split()
    process.wait(20)
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


def test_it_has_a_session_of_its_own():
    process = spawn_at_normal_priority([sys.executable, "-c", "import time; time.sleep(30)"])
    assert os.getsid(process.pid) == process.pid
    process.kill()
    process.wait()


def test_a_program_that_is_not_there_is_named():
    with pytest.raises(LogError, match="/nonexistent/python"):
        spawn_at_normal_priority(["/nonexistent/python"])
