"""One controller on the simulated CAN bus: its transmit queue and its error confinement.

Source: Bosch CAN specification 2.0 (1991), part B, chapter 8 (fault confinement); error frames as Linux can-dev reports
them to a socket.
"""

from __future__ import annotations

import enum
import heapq
from dataclasses import dataclass, field

from sim.can_frame import CanFrame, arbitration_key, bus_off_frame, controller_error_frame, restarted_frame

WARNING_LIMIT = 96
PASSIVE_LIMIT = 128
BUS_OFF_LIMIT = 256

QueuedFrame = tuple[int, int, int, CanFrame]
"""Rank among this node's own frames, sequence number, arbitration key, frame."""


class TransmitOrder(enum.Enum):
    """Which of its waiting frames a node sends first: the lowest identifier (mailboxes) or the oldest (a queue)."""

    PRIORITY = "priority"
    FIFO = "fifo"


class ErrorState(enum.Enum):
    """Error confinement of a node; `WARNING` (a counter at 96) changes nothing on the wire."""

    ACTIVE = "error-active"
    WARNING = "error-warning"
    PASSIVE = "error-passive"
    BUS_OFF = "bus-off"


# Looked at with every frame; through the enum each look is a call of a function in Python 3.11.
_PRIORITY, _BUS_OFF = TransmitOrder.PRIORITY, ErrorState.BUS_OFF


@dataclass(slots=True, eq=False)
class BusNode:
    """State and counters of one controller; made by `CanBus.attach` and changed only by the bus.

    `tec` and `rec` are the transmit and receive error counters. `recessive_sequences` counts towards recovery from
    bus-off and is None when none was requested. The counting methods return the error frame that a change of state
    reports to this node, or None.
    """

    name: str
    capacity: int
    order: TransmitOrder
    echo: bool
    state: ErrorState = ErrorState.ACTIVE
    tec: int = 0
    rec: int = 0
    sent: int = 0
    received: int = 0
    refused_full: int = 0
    refused_bus_off: int = 0
    lost_by_bus_off: int = 0
    arbitrations_lost: int = 0
    transmit_errors: int = 0
    bus_off_count: int = 0
    queue: list[QueuedFrame] = field(default_factory=list)
    on_wire: QueuedFrame | None = None
    eligible_ns: int = 0
    recessive_sequences: int | None = None

    @property
    def pending(self) -> int:
        """Frames accepted and not yet on the bus as a whole."""
        return len(self.queue) + (self.on_wire is not None)

    def push(self, sequence: int, frame: CanFrame) -> bool:
        """Queue a frame; False, and a counter, when the queue is full or the node is bus-off."""
        if self.state is _BUS_OFF:
            self.refused_bus_off += 1
            return False
        if len(self.queue) + (self.on_wire is not None) >= self.capacity:
            self.refused_full += 1
            return False
        key = arbitration_key(frame)
        heapq.heappush(self.queue, (key if self.order is _PRIORITY else 0, sequence, key, frame))
        return True

    def start(self) -> CanFrame:
        """Move the head of the queue to the wire."""
        self.on_wire = heapq.heappop(self.queue)
        return self.on_wire[3]

    def count_sent(self) -> CanFrame | None:
        """The frame on the wire went through."""
        self.sent += 1
        self.on_wire = None
        if not self.tec or self.state is _BUS_OFF:
            return None
        self.tec -= 1
        return self._confine()

    def count_transmit_error(self, acknowledged: bool) -> CanFrame | None:
        """The frame on the wire was destroyed, or nobody acknowledged it; it goes back to the queue."""
        self.transmit_errors += 1
        item, self.on_wire = self.on_wire, None
        if self.state is ErrorState.BUS_OFF or item is None:
            self.lost_by_bus_off += 1
            return None
        heapq.heappush(self.queue, item)
        # An error-passive node does not count missing acknowledgements, or every unplugged node would go bus-off.
        if acknowledged or self.tec < PASSIVE_LIMIT:
            self.tec += 8
        return self._confine()

    def count_received(self) -> CanFrame | None:
        """A frame of another node was received."""
        if not self.rec:
            return None
        self.rec = self.rec - 1 if self.rec < PASSIVE_LIMIT else 120
        return self._confine()

    def count_receive_error(self) -> CanFrame | None:
        """A frame of another node was destroyed."""
        self.rec = min(self.rec + 1, 255)
        return self._confine()

    def force_bus_off(self) -> CanFrame | None:
        """Leave the bus as if the transmit error counter had run over."""
        self.tec = BUS_OFF_LIMIT
        return self._confine()

    def recover(self) -> CanFrame:
        """Come back from bus-off with clean counters."""
        self.recessive_sequences = None
        self.tec = self.rec = 0
        self.state = ErrorState.ACTIVE
        return restarted_frame()

    def _confine(self) -> CanFrame | None:
        worst = max(self.tec, self.rec)
        if self.tec >= BUS_OFF_LIMIT:
            state = ErrorState.BUS_OFF
        elif worst >= PASSIVE_LIMIT:
            state = ErrorState.PASSIVE
        else:
            state = ErrorState.WARNING if worst >= WARNING_LIMIT else ErrorState.ACTIVE
        if state is self.state:
            return None
        self.state = state
        if state is not ErrorState.BUS_OFF:
            return controller_error_frame(self.tec, self.rec, _controller_bits(state, self.tec >= self.rec))
        self.bus_off_count += 1
        self.lost_by_bus_off += len(self.queue)
        self.queue.clear()
        return bus_off_frame()


def _controller_bits(state: ErrorState, transmit_side: bool) -> int:
    """CAN_ERR_CRTL_* for the state that a node has just entered."""
    if state is ErrorState.ACTIVE:
        return 0x40
    if state is ErrorState.WARNING:
        return 0x08 if transmit_side else 0x04
    return 0x20 if transmit_side else 0x10
