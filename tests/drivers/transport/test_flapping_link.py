"""A link that comes and goes hundreds of times leaves no file descriptor and no thread behind."""

import os
import socket
import threading
from pathlib import Path

import pytest

from drivers.transport.can import CanMedium
from drivers.transport.reconnecting import BackoffPolicy, LinkLostError, ReconnectingTransport
from drivers.transport.serial import SerialMedium
from tests.drivers.waiting import wait_until

IMMEDIATELY = BackoffPolicy(first_s=0.0002, longest_s=0.0002, steady_s=10.0)
SETTLED, RECONNECTS = 20, 300
MINUTES_S = 100.0


class Flapping:
    """A medium that is lost as soon as it is there; `seen`: what the process held each time while it was there."""

    def __init__(self, medium):
        self._medium = medium
        self.name, self.explain = medium.name, medium.explain
        self.seen = []

    def connect(self, counters):
        connection, seen = self._medium.connect(counters), self.seen

        class BrokenConnection:
            write, close = connection.write, connection.close

            def read(self):
                seen.append(resources())
                raise LinkLostError("flapped")

        return BrokenConnection()


@pytest.fixture
def serial_line(terminal):
    return Flapping(SerialMedium(str(terminal.path), 115_200))


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
        yield Flapping(CanMedium("unixcan", address, 500_000))
        hub.shutdown(socket.SHUT_RDWR)
        thread.join()


def resources():
    return len(os.listdir("/proc/self/fd")), threading.active_count()


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("kind", ["serial_line", "can_bus"])
def test_descriptors_and_threads_stay_as_many(kind, request):
    medium = request.getfixturevalue(kind)
    before = resources()
    transport = ReconnectingTransport(medium, backoff=IMMEDIATELY)
    transport.open()
    wait_until(lambda: len(medium.seen) > RECONNECTS, MINUTES_S)
    transport.close()
    # The hub may just be hanging up, and what an earlier test left behind may end meanwhile.
    wait_until(lambda: all(now <= then for now, then in zip(resources(), before, strict=True)))
    first, last = medium.seen[SETTLED : 2 * SETTLED], medium.seen[-SETTLED:]
    (first_files, first_threads), (last_files, last_threads) = (
        tuple(map(max, zip(*looks, strict=True))) for looks in (first, last)
    )
    assert last_files <= first_files + 1
    assert last_threads <= first_threads
