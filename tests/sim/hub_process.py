"""A hub in a process of its own: `python hub_process.py PATH [INTERFACE CHANNEL KEY=JSON ...]`.

What is on the python-can interface, where one is given, is a node of the bus, as a board behind SLCAN.
"""

from __future__ import annotations

import json
import select
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from drivers.types import Frame
from sim.bus import CanBus, DeliveredFrame
from sim.can_protocol import CanFrame
from sim.hub import Hub
from sim.process import StopSignal
from sim.python_can_link import PythonCanLink

HUB_PROCESS = str(Path(__file__))
# Chosen: as the robot's own.
GUEST_QUEUE = 64


class Guest:
    """A node of `bus` for whatever is on `link`: what one has, the other gets."""

    def __init__(self, bus: CanBus, link: PythonCanLink) -> None:
        self.link = link
        self._bus = bus
        self._node = bus.attach("guest", capacity=GUEST_QUEUE)

    def take(self, now_ns: int) -> None:
        """Put on the bus what has come over the link; what does not fit the node's queue is counted there."""
        self.link.collect(now_ns)
        for received in self.link.advance(now_ns):
            frame = received.frame
            self._bus.send(self._node, CanFrame(frame.can_id, frame.data, frame.extended))

    def give(self, deliveries: Sequence[DeliveredFrame]) -> None:
        """Send over the link what the node has received."""
        self.link.send(
            [
                Frame(delivery.frame.can_id, delivery.frame.data, delivery.frame.extended)
                for delivery in deliveries
                if self._node in delivery.receivers and not (delivery.frame.error or delivery.frame.remote)
            ]
        )


def main(path: str, *guest_on: str) -> None:
    """Serve the hub; print a line when it can be opened."""
    stop, now_ns = StopSignal(), time.monotonic_ns()
    hub, guest = Hub(Path(path), now_ns), None
    if guest_on:
        interface, channel, *rest = guest_on
        options = {key: json.loads(value) for key, _, value in (option.partition("=") for option in rest)}
        guest = Guest(hub.bus, PythonCanLink(interface, channel, now_ns, **options))
    print(f"ready {path}", flush=True)
    while not stop.requested:
        times = [hub.next_event_ns(), None if guest is None else guest.link.next_event_ns()]
        due_ns = min((t for t in times if t is not None), default=None)
        timeout_s = None if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
        others = [] if guest is None else guest.link.filenos()
        select.select((hub.fileno(), stop.fileno(), *others), (), (), timeout_s)
        now_ns = time.monotonic_ns()
        if guest is not None:
            guest.take(now_ns)
        hub.collect(now_ns)
        deliveries = hub.advance(now_ns)
        if guest is not None:
            guest.give(deliveries)
    hub.close()
    if guest is not None:
        guest.link.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
