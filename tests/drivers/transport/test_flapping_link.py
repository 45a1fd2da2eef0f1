"""A link that comes and goes a thousand times leaves no file descriptor and no thread behind."""

import os
import socket
import threading
from pathlib import Path

import pytest

from drivers.transport.backoff import BackoffPolicy
from drivers.transport.can import CanMedium
from drivers.transport.reconnecting import LinkLostError, ReconnectingTransport
from drivers.transport.serial import SerialMedium
from tests.drivers.transport.pseudo_terminal import PseudoTerminal
from tests.drivers.waiting import wait_until

AT_ONCE = BackoffPolicy(first_s=0.0002, longest_s=0.0002, steady_s=10.0)
SETTLED, RECONNECTS = 20, 1000
MINUTES_S = 100.0


class Flapping:
    """A medium that is lost as soon as it is there."""

    def __init__(self, medium):
        self._medium = medium
        self.name, self.explain = medium.name, medium.explain

    def connect(self, counters):
        connection = self._medium.connect(counters)

        class Lost:
            write, close = connection.write, connection.close

            def read(self):
                raise LinkLostError("flapped")

        return Lost()


@pytest.fixture
def serial_line():
    terminal = PseudoTerminal()
    yield Flapping(SerialMedium(str(terminal.path), 115_200))
    terminal.remove()


@pytest.fixture
def can_bus(tmp_path):
    """A hub that hangs up on everybody."""
    address = str(tmp_path / "bus")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as hub:
        hub.bind(address)
        hub.listen()

        def hang_up():
            while True:
                try:
                    hub.accept()[0].close()
                except OSError:
                    return

        thread = threading.Thread(target=hang_up, daemon=True)
        thread.start()
        yield CanMedium("unixcan", address, 500_000)
        hub.shutdown(socket.SHUT_RDWR)
        thread.join()


def resources():
    return len(os.listdir("/proc/self/fd")), threading.active_count()


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("kind", ["serial_line", "can_bus"])
def test_descriptors_and_threads_stay_as_many(kind, request):
    medium = request.getfixturevalue(kind)
    before = resources()
    transport = ReconnectingTransport(medium, backoff=AT_ONCE)
    transport.open()
    seen = []
    for target in (SETTLED, RECONNECTS):
        wait_until(lambda: transport.generation >= target, MINUTES_S)  # noqa: B023
        # In between a connection may be open or not: the most of many looks is what counts.
        seen.append(tuple(map(max, zip(*(resources() for _ in range(200)), strict=True))))
    transport.close()
    assert resources() == before
    (few_files, few_threads), (many_files, many_threads) = seen
    assert many_files <= few_files + 1
    assert many_threads == few_threads
