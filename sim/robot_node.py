"""The robot's controller on a simulated CAN bus, its restart after bus-off, and the faulty node beside it."""

from __future__ import annotations

from collections.abc import Sequence

from drivers.types import Frame, ReceivedFrame
from sim.bus import CanBus, Delivery
from sim.bus_node import ErrorState
from sim.can_frame import CanFrame
from sim.faults import ROBOT_NODE

ROBOT_QUEUE = 64
BABBLER_QUEUE = 32
_BUS_OFF = ErrorState.BUS_OFF
RESTART_DELAY_NS = 200_000_000
"""After bus-off the robot's controller asks for recovery so much later, as can-dev does with restart-ms 200."""


class RobotNode:
    """Attaches the robot and the babbling node to `bus`; `node` is the robot's."""

    def __init__(self, bus: CanBus) -> None:
        self._bus = bus
        self.node = bus.attach(ROBOT_NODE, capacity=ROBOT_QUEUE)
        self._babbler = bus.attach("babbler", capacity=BABBLER_QUEUE)
        self.restart_ns: int | None = None

    @property
    def error_counters(self) -> tuple[int, int]:
        """Error counters of the robot's node; the first is 256 at bus-off."""
        return self.node.tec, self.node.rec

    def take(self, now_ns: int, deliveries: Sequence[Delivery]) -> list[ReceivedFrame]:
        """The data frames among the bus's deliveries that the robot has received; minds the restart after bus-off."""
        node = self.node
        if node.state is _BUS_OFF and node.recessive_sequences is None:
            if self.restart_ns is None:
                self.restart_ns = now_ns + RESTART_DELAY_NS
            elif now_ns >= self.restart_ns:
                self.restart_ns = None
                self._bus.request_recovery(node)
        return [
            ReceivedFrame(delivery.t_ns, Frame(delivery.frame.can_id, delivery.frame.data))
            for delivery in deliveries
            if node in delivery.receivers and _is_for_robots(delivery.frame)
        ]

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames; the node counts those that do not fit."""
        for frame in frames:
            self._bus.send(self.node, CanFrame(frame.can_id, frame.data))

    def babble(self, frame: Frame) -> None:
        """Send `frame` from the faulty node; if its queue is full it is on the bus as often as the bus allows.

        Thrown off the bus by what it collides with, it comes back as soon as the bus allows.
        """
        self._bus.request_recovery(self._babbler)
        self._bus.send(self._babbler, CanFrame(frame.can_id, frame.data))


def _is_for_robots(frame: CanFrame) -> bool:
    return not (frame.error or frame.remote or frame.extended)
