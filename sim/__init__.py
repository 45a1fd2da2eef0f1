"""Simulated replacement of the robot: plant, mock CAN bus, virtual robot.

Here the seam between them: the link of the virtual robot, be it a CAN bus or a serial line, and the robot's controller
as a node on a bus.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from drivers.types import Frame, ReceivedFrame
from sim.bus import BusFault, CanBus, DeliveredFrame
from sim.can_protocol import CanFrame, ErrorState

ROBOT_NODE = "robot"
# Chosen: as of a controller with a software queue; the babbler's, so that it always has a frame to send.
ROBOT_QUEUE = 64
BABBLER_QUEUE = 32
_BUS_OFF = ErrorState.BUS_OFF
RESTART_DELAY_NS = 200_000_000
"""After bus-off the robot's controller asks for recovery so much later, as can-dev does with restart-ms 200."""


class LinkFaultError(Exception):
    """A fault that this kind of link cannot have; the message says so in one line."""


class FaultyLink(Protocol):
    """Faults of a link; each raises LinkFaultError if the link cannot have it."""

    def unplug(self, until_ns: int) -> None:
        """Break the line until then."""

    def force_bus_off(self, who: str) -> None:
        """Put "host" or "robot" into bus-off."""

    def babble(self, frame: Frame) -> None:
        """Let a further, faulty node send `frame` once."""

    def set_bus_fault(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame."""


class RobotLink(FaultyLink, Protocol):
    """The robot's end of a link. Never blocks; all times are monotonic nanoseconds that do not go back."""

    @property
    def address(self) -> str:
        """Medium and address at which a host reaches the robot, in one line."""

    @property
    def error_counters(self) -> tuple[int, int]:
        """Transmit and receive error counters of the robot's controller; the first is over 255 at bus-off."""

    def filenos(self) -> list[int]:
        """Descriptors that become readable when a host has done something."""

    def next_event_ns(self) -> int | None:
        """Return when `collect` and `advance` are due even if no host does anything; None if never."""

    def collect(self, now_ns: int) -> int:
        """Take in what hosts wrote; return how many of their frames now wait to be let onto the line."""

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Let the oldest `admit` waiting frames (None: all) onto the line; return what the robot has by `now_ns`."""

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames at the time of the last `advance`; what does not fit is counted and lost."""

    def summary(self) -> str:
        """Counters in one line."""

    def close(self) -> None:
        """Release the link's medium; may be called twice."""


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

    def take(self, now_ns: int, deliveries: Sequence[DeliveredFrame]) -> list[ReceivedFrame]:
        """Return the data frames among the bus's deliveries that the robot has received.

        Minds the restart after bus-off.
        """
        node = self.node
        if node.state is _BUS_OFF and node.recessive_sequences is None:
            if self.restart_ns is None:
                self.restart_ns = now_ns + RESTART_DELAY_NS
            elif now_ns >= self.restart_ns:
                self.restart_ns = None
                self._bus.request_recovery(node)
        return [
            ReceivedFrame(delivery.t_ns, Frame(delivery.frame.can_id, delivery.frame.data, delivery.frame.extended))
            for delivery in deliveries
            if node in delivery.receivers and _is_for_robots(delivery.frame)
        ]

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames; the node counts those that do not fit."""
        for frame in frames:
            self._bus.send(self.node, CanFrame(frame.can_id, frame.data, frame.extended))

    def babble(self, frame: Frame) -> None:
        """Send `frame` from the faulty node; if its queue is full it is on the bus as often as the bus allows.

        Thrown off the bus by what it collides with, it comes back as soon as the bus allows.
        """
        self._bus.request_recovery(self._babbler)
        self._bus.send(self._babbler, CanFrame(frame.can_id, frame.data, frame.extended))


def _is_for_robots(frame: CanFrame) -> bool:
    return not (frame.error or frame.remote)
