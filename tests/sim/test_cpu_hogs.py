"""Busy processes begin and end with their fault."""

import os
import time

import pytest

from sim.cpu_hogs import CpuHogs
from sim.fault_schedule import parse_schedule


def test_hogs_run_while_the_fault_lasts_and_not_beyond_the_block():
    faults = parse_schedule('[[fault]]\nkind="cpu_hog"\nat_s=0\nfor_s=1\ncores=2').faults
    with CpuHogs() as hogs:
        hogs.begin(faults[0])
        running = hogs._busy[faults[0].number]
        assert [process.poll() for process in running] == [None, None]
        hogs.end(faults[0])
        assert all(process.poll() is not None for process in running)
        hogs.begin(faults[0])
        running = hogs._busy[faults[0].number]
    assert all(process.poll() is not None for process in running)


def test_other_faults_are_not_for_it():
    (fault,) = parse_schedule('[[fault]]\nkind="sigstop"\nat_s=0\nfor_s=1').faults
    with CpuHogs() as hogs:
        hogs.begin(fault)
        hogs.end(fault)
        assert hogs._busy == {}


def test_they_are_no_real_time_processes_though_their_parent_is():
    (fault,) = parse_schedule('[[fault]]\nkind="cpu_hog"\nat_s=0\nfor_s=1\ncores=1').faults
    with CpuHogs() as hogs:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        except PermissionError:
            pytest.skip("no real-time scheduling allowed here")
        try:
            hogs.begin(fault)
        finally:
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        pid = hogs._busy[1][0].pid
        deadline = time.monotonic() + 10.0
        while os.sched_getscheduler(pid) != os.SCHED_OTHER:
            assert time.monotonic() < deadline
            time.sleep(0.01)
