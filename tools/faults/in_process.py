"""A CAN bus with one host in simulated time, in the host's own process: no socket, thread or clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict

from drivers.transport.reconnecting import RECEIVE_CAPACITY
from drivers.types import Frame, LinkState, OutgoingFrame, ReceivedFrame, TransportStats
from sim import LinkFaultError, RobotNode
from sim.bus import BusFault, CanBus, DeliveredFrame
from sim.can_protocol import BusNode, CanFrame, ErrorState, TransmitOrder

# Chosen: as a client's of the hub.
HOST_QUEUE = 32
_BUS_OFF = ErrorState.BUS_OFF
REOPEN_NS = 100_000_000
"""After bus-off or a lost line the host's transport opens the bus again so much later."""


class SimulatedCan:
    """The robot's end, a `sim.FaultyLink`; `host` is the `drivers.types.Transport` of the other.

    Time is that of the last `advance`. A silent node acknowledges all frames, as the hub's does.
    """

    def __init__(self, bitrate: int = 500_000, start_ns: int = 0) -> None:
        self.bus = CanBus(bitrate, start_ns=start_ns)
        self.bus.attach("monitor")
        self.robot = RobotNode(self.bus)
        self.host = HostTransport(self.bus)

    @property
    def error_counters(self) -> tuple[int, int]:
        """Error counters of the robot's node; the first is 256 at bus-off."""
        return self.robot.error_counters

    def advance(self, now_ns: int) -> list[ReceivedFrame]:
        """Run the bus up to `now_ns`; return what the robot has received, and hand the host what it has."""
        deliveries = self.bus.advance(now_ns)
        self.host.take(now_ns, deliveries)
        return self.robot.take(now_ns, deliveries)

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames."""
        self.robot.send(frames)

    def unplug(self, until_ns: int) -> None:
        """Cut the host off until then."""
        self.host.lose(until_ns, "unplugged")

    def force_bus_off(self, who: str) -> None:
        """Put the host's or the robot's controller into bus-off."""
        if who not in ("host", "robot"):
            raise LinkFaultError(f"bus_off {who}: say host or robot")
        node = self.host.node if who == "host" else self.robot.node
        if node is not None:
            self.bus.force_bus_off(node)

    def babble(self, frame: Frame) -> None:
        """Send `frame` from a third node."""
        self.robot.babble(frame)

    def set_bus_fault(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame."""
        self.bus.fault = fault


class HostTransport:
    """The host's end of the bus; satisfies `drivers.types.Transport`, and reconnects as `drivers.transport` does."""

    def __init__(self, bus: CanBus) -> None:
        self.node: BusNode | None = None
        self._bus = bus
        self._counts = asdict(TransportStats())
        self._open = False
        self._generation = 0
        self._reopen_ns: int | None = None
        self._last_error: str | None = None
        self._incoming: deque[ReceivedFrame] = deque()

    @property
    def name(self) -> str:
        """Name of the medium, which has no address."""
        return "simulated CAN"

    @property
    def state(self) -> LinkState:
        """Whether frames can be carried now."""
        if not self._open:
            return LinkState.CLOSED
        return LinkState.CONNECTING if self.node is None else LinkState.UP

    @property
    def generation(self) -> int:
        """Number of times the link has come up."""
        return self._generation

    @property
    def stats(self) -> TransportStats:
        """A snapshot of the counters."""
        return TransportStats(**self._counts)

    @property
    def last_error(self) -> str | None:
        """The newest error in words, or None if there was none since the link last came up."""
        return self._last_error

    def open(self) -> None:
        """Connect the host to the bus."""
        self._open = True
        self._connect()

    def close(self) -> None:
        """Disconnect the host from the bus; safe to call twice."""
        self._leave()
        self._open, self._reopen_ns = False, None

    def send(self, outgoing: OutgoingFrame, now_ns: int) -> bool:
        """Queue a frame on the host's controller; False (and a counter) if it expired or does not fit."""
        if outgoing.deadline_ns < now_ns:
            self._counts["expired"] += 1
            return False
        if self.node is None:
            self._counts["send_errors"] += 1
            return False
        frame = outgoing.frame
        if not self._bus.send(self.node, CanFrame(frame.can_id, frame.data, frame.extended)):
            self._counts["transmit_queue_full"] += 1
            return False
        self._counts["frames_sent"] += 1
        return True

    def receive(self) -> Sequence[ReceivedFrame]:
        """Return all frames received since the last call, oldest first."""
        received = tuple(self._incoming)
        self._incoming.clear()
        return received

    def take(self, now_ns: int, deliveries: Sequence[DeliveredFrame]) -> None:
        """Keep what this node has received; open again what is due."""
        if self._reopen_ns is not None and now_ns >= self._reopen_ns:
            self._connect()
        node = self.node
        counts = self._counts
        for delivery in deliveries:
            if node not in delivery.receivers:
                continue
            frame = delivery.frame
            if frame.error:
                counts["bus_errors"] += 1
                continue
            counts["frames_received"] += 1
            counts["bytes_received"] += len(frame.data)
            self._incoming.append(ReceivedFrame(delivery.t_ns, Frame(frame.can_id, frame.data, frame.extended)))
        while len(self._incoming) > RECEIVE_CAPACITY:
            self._incoming.popleft()
            counts["receive_overflow"] += 1
        if node is not None and node.state is _BUS_OFF:
            counts["bus_off"] += 1
            self.lose(now_ns + REOPEN_NS, "the controller is bus-off")

    def lose(self, until_ns: int, why: str) -> None:
        """Drop the link until then, with all that is under way."""
        if not self._open:
            return
        self._leave()
        self._last_error = why
        self._reopen_ns = until_ns

    def _connect(self) -> None:
        self._leave()
        self._reopen_ns = None
        # SocketCAN's queue sends in the order of writing.
        self.node = self._bus.attach("host", capacity=HOST_QUEUE, order=TransmitOrder.FIFO)
        self._generation += 1
        self._last_error = None
        self._counts["reconnects"] += self._generation > 1

    def _leave(self) -> None:
        if self.node is not None:
            self._bus.detach(self.node)
            self.node = None
        self._incoming.clear()
