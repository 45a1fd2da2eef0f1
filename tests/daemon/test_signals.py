import os
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

from disco_hw.daemon.process import StopSignals
from tests.tables import thinned

STOP_SIGNALS = [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]
DAEMON = """
import signal
import sys
from disco_hw.daemon.loop import MonotonicClock
from disco_hw.daemon.loop import Loop
from disco_hw.daemon.process import StopSignals
from tests.tables import thinned
from disco_hw.daemon.process import StopPath

def stop_wheels():
    print("stopping", flush=True)
    # Until the test has done what it does meanwhile.
    sys.stdin.readline()
    print("wheels stand", flush=True)

# Whoever runs these tests may have set its children to ignore the signal, as nohup does.
signal.signal(signal.SIGHUP, getattr(signal, sys.argv[1]))
path = StopPath()
path.add("log", lambda: print("log closed", flush=True))
path.add("wheels", stop_wheels)
loop = Loop(MonotonicClock(), 50.0)
def tick(now_ns):
    if loop.stats.ticks == 0:
        print("running", flush=True)
with StopSignals() as signals:
    loop.run(tick, lambda: signals.received is not None)
    path.run()
print(signals.received.name, flush=True)
"""


@contextmanager
def daemon(hangup="SIG_DFL"):
    """A loop that runs in a process of its own, started with this disposition of SIGHUP."""
    command = [sys.executable, "-c", DAEMON, hangup]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as started:
        try:
            assert started.stdout.readline() == "running\n"
            yield started
        finally:
            started.kill()


@pytest.fixture
def process():
    with daemon() as started:
        yield started


def test_under_nohup_the_loop_goes_on_after_a_hangup():
    with daemon("SIG_IGN") as process:
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=60)
        assert output.splitlines()[-1] == "SIGTERM"


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_stops_the_loop_and_the_stop_path_runs_in_order(process, number):
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert output.splitlines() == ["stopping", "wheels stand", "log closed", number.name]
    assert process.returncode == 0


@thinned("second", STOP_SIGNALS, quick=1)
def test_a_second_signal_does_not_break_the_stop_path_off(process, second):
    process.send_signal(signal.SIGTERM)
    assert process.stdout.readline() == "stopping\n"
    process.send_signal(second)
    output, _ = process.communicate(timeout=60)
    assert output.splitlines() == ["wheels stand", "log closed", "SIGTERM"]
    assert process.returncode == 0


def test_the_former_handlers_come_back():
    before = [signal.getsignal(number) for number in STOP_SIGNALS]
    with StopSignals() as signals:
        assert [signal.getsignal(number) for number in STOP_SIGNALS] != before
        os.kill(os.getpid(), signal.SIGTERM)
    assert signals.received is signal.SIGTERM
    assert [signal.getsignal(number) for number in STOP_SIGNALS] == before


@pytest.mark.parametrize(("number", "noticed"), [(signal.SIGINT, True), (signal.SIGTERM, True), (signal.SIGHUP, False)])
def test_of_ignored_signals_only_that_of_the_terminal_stays_ignored(number, noticed):
    former = signal.signal(number, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            os.kill(os.getpid(), number)
            assert (signals.received is number) is noticed
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, former)
