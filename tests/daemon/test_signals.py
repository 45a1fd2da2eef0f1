import multiprocessing
import os
import signal
from contextlib import closing, suppress

import pytest

from disco_hw.daemon.loop import Loop, MonotonicClock
from disco_hw.daemon.process import StopPath, StopSignals

STOP_SIGNALS = [signal.SIGTERM, signal.SIGINT, signal.SIGHUP]


def run_loop(connection, hangup):
    """Run a loop until a signal comes, and then the stop path, which waits for a message before the wheels stand."""

    def stop_wheels():
        connection.send("stopping")
        connection.recv()
        connection.send("wheels stand")

    # Whoever runs these tests may have set its children to ignore the signal, as nohup does.
    signal.signal(signal.SIGHUP, hangup)
    path = StopPath()
    path.add("log", lambda: connection.send("log closed"))
    path.add("wheels", stop_wheels)
    loop = Loop(MonotonicClock(), 50.0)
    with StopSignals() as signals:
        loop.run(lambda _now_ns: loop.stats.ticks or connection.send("running"), lambda: signals.received is not None)
        path.run()
    connection.send(signals.received.name)


class Daemon:
    """A loop that runs in a process of its own, started with this disposition of SIGHUP."""

    def __init__(self, hangup=signal.SIG_DFL):
        context = multiprocessing.get_context("fork")
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=run_loop, args=(theirs, hangup))
        self._process.start()
        theirs.close()
        assert self.next() == "running"

    def send_signal(self, number):
        os.kill(self._process.pid, number)

    def next(self):
        assert self._connection.poll(60.0)
        return self._connection.recv()

    def to_its_end(self):
        """What else it reports, once the wheels may stand; it ends with exit code 0."""
        self._connection.send("stand")
        reported = []
        with suppress(EOFError):
            while True:
                reported.append(self.next())
        self._process.join(60.0)
        assert self._process.exitcode == 0
        return reported

    def close(self):
        self._process.kill()
        self._process.join()
        self._connection.close()


@pytest.fixture
def process():
    with closing(Daemon()) as started:
        yield started


def test_under_nohup_the_loop_goes_on_after_a_hangup():
    with closing(Daemon(signal.SIG_IGN)) as process:
        process.send_signal(signal.SIGHUP)
        process.send_signal(signal.SIGTERM)
        assert process.to_its_end()[-1] == "SIGTERM"


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_stops_the_loop_and_the_stop_path_runs_in_order(process, number):
    process.send_signal(number)
    assert process.to_its_end() == ["stopping", "wheels stand", "log closed", number.name]


@pytest.mark.parametrize("second", STOP_SIGNALS)
def test_a_second_signal_does_not_break_the_stop_path_off(process, second):
    process.send_signal(signal.SIGTERM)
    assert process.next() == "stopping"
    process.send_signal(second)
    assert process.to_its_end() == ["wheels stand", "log closed", "SIGTERM"]


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
