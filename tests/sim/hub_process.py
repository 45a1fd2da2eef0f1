"""A hub in a process of its own: `python hub_process.py PATH [INTERFACE CHANNEL KEY=JSON ...]`.

What is on the python-can interface, where one is given, is a node of the bus, as a board behind SLCAN.
"""

from __future__ import annotations

import json
import select
import sys
import time
from pathlib import Path

import can

from drivers.types import Frame
from sim.hub import Hub
from sim.process import StopSignal
from sim.python_can_link import PythonCanLink
from sim.unixcan import UnixCanBus

HUB_PROCESS = str(Path(__file__))


class Guest:
    """A client of the hub at `path` for whatever is on `link`: what one has, the other gets."""

    def __init__(self, path: str, link: PythonCanLink) -> None:
        self.link = link
        self._bus = UnixCanBus(path)

    def filenos(self) -> list[int]:
        """Descriptors that are readable when there is something to carry."""
        return [self._bus.fileno(), *self.link.filenos()]

    def carry(self, now_ns: int) -> None:
        """Put on the bus what has come over the link, and send over the link what has come over the bus."""
        self.link.collect(now_ns)
        for received in self.link.advance(now_ns):
            frame = received.frame
            self._bus.send(
                can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=frame.extended), timeout=0
            )
        while message := self._bus.recv(0):
            if not (message.is_error_frame or message.is_remote_frame):
                self.link.send([Frame(message.arbitration_id, bytes(message.data), message.is_extended_id)])

    def close(self) -> None:
        """Leave the bus and the link."""
        self._bus.shutdown()
        self.link.close()


def main(path: str, *guest_on: str) -> None:
    """Serve the hub; print a line when it can be opened."""
    stop, now_ns = StopSignal(), time.monotonic_ns()
    hub, guest = Hub(Path(path), now_ns), None
    if guest_on:
        interface, channel, *rest = guest_on
        options = {key: json.loads(value) for key, _, value in (option.partition("=") for option in rest)}
        guest = Guest(path, PythonCanLink(interface, channel, now_ns, **options))
    print(f"ready {path}", flush=True)
    while not stop.requested:
        times = [hub.next_event_ns(), None if guest is None else guest.link.next_event_ns()]
        due_ns = min((t for t in times if t is not None), default=None)
        timeout_s = None if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
        others = [] if guest is None else guest.filenos()
        select.select((*hub.filenos(), stop.fileno(), *others), (), (), timeout_s)
        now_ns = time.monotonic_ns()
        if guest is not None:
            guest.carry(now_ns)
        hub.collect(now_ns)
        hub.advance(now_ns)
    if guest is not None:
        guest.close()
    hub.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
