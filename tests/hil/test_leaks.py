"""Nothing grows: memory over a drive, descriptors and threads over reconnections.

By default a short part; DISCO_HW_LEAK_HOURS=1 and DISCO_HW_RECONNECTS=1000 ask for the whole.
"""

import gc
import os
import sys
import threading
import time
from pathlib import Path

import pytest

from drivers.transport import open_transport
from drivers.types import LinkState
from sim.fault_schedule import FaultSchedule
from sim.hub import Hub
from sim.serial_line import SerialLine
from tools.faults.run import FaultRun

pytestmark = pytest.mark.long

HOURS = float(os.environ.get("DISCO_HW_LEAK_HOURS", "0"))
RECONNECTS = int(os.environ.get("DISCO_HW_RECONNECTS", "30"))
BLOCKS_OF_SLACK = 600
"""One object kept per tick of the shortest run would be more than these."""


def blocks():
    gc.collect()
    return sys.getallocatedblocks()


@pytest.mark.timeout(300.0 + 3600.0 * HOURS)
def test_memory_is_flat_while_the_robot_drives():
    run = FaultRun(FaultSchedule(0, ()), cycle_us=5000)
    run.run(8.0)
    run.run(HOURS * 1800.0)
    half = blocks()
    run.run(HOURS * 1800.0 + 14.0)
    assert run.core.last.output.running
    assert blocks() - half < BLOCKS_OF_SLACK


@pytest.mark.skipif("DISCO_HW_LEAK_HOURS" in os.environ, reason="the long run is asked for alone")
def test_a_leak_of_one_object_a_tick_would_be_seen(monkeypatch):
    run = FaultRun(FaultSchedule(0, ()), cycle_us=5000)
    kept, put = [], run.log.put
    monkeypatch.setattr(run.log, "put", lambda now_ns, recorded: (kept.append(float(now_ns)), put(now_ns, recorded)))
    run.run(2.0)
    before = blocks()
    run.run(14.0)
    assert blocks() - before > BLOCKS_OF_SLACK


class Served:
    """Pumps one end of a link in a thread of its own, as the virtual robot's process does."""

    def __init__(self, pump):
        self._pump = pump
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._end.wait(0.0005):
            self._pump(time.monotonic_ns())

    def stop(self):
        self._end.set()
        self._thread.join()


@pytest.fixture(params=["can", "serial"])
def link(request, tmp_path):
    """Options of a transport, and a way to cut the line for a moment."""
    now_ns = time.monotonic_ns()
    end = Hub(tmp_path / "bus", now_ns) if request.param == "can" else SerialLine(tmp_path / "tty", now_ns)

    def pump(now):
        end.collect(now)
        end.advance(now)

    served = Served(pump)
    options = {
        "kind": request.param, "interface": "unixcan", "channel": str(tmp_path / "bus"), "bitrate": 500_000,
        "port": str(tmp_path / "tty"), "baud": 921_600,
    }  # fmt: skip
    yield options, served, end
    served.stop()
    end.close()


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def wait_up(transport):
    deadline = time.monotonic() + 20.0
    while transport.state is not LinkState.UP:
        assert time.monotonic() < deadline, transport.last_error
        time.sleep(0.001)


def test_descriptors_and_threads_stay_the_same_over_connections(link):
    options, _, _ = link
    counts = set()
    for k in range(RECONNECTS):
        transport = open_transport(**options)
        wait_up(transport)
        if k > 2:
            counts.add((open_files(), threading.active_count()))
        transport.close()
    assert max(files for files, _ in counts) - min(files for files, _ in counts) <= 2
    assert len({threads for _, threads in counts}) == 1
