"""What the virtual robot's process needs of a link, be it a CAN bus or a serial line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from drivers.types import Frame, ReceivedFrame
from sim.bus import BusFault


class LinkFaultError(Exception):
    """A fault that this kind of link cannot have; the message says so in one line."""


class RobotLink(Protocol):
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
        """When `collect` and `advance` are due even if no host does anything; None if never."""

    def collect(self, now_ns: int) -> int:
        """Take in what hosts wrote; return how many of their frames now wait to be let onto the line."""

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Let the oldest `admit` waiting frames (None: all) onto the line; return what the robot has by `now_ns`."""

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames at the time of the last `advance`; what does not fit is counted and lost."""

    def unplug(self, until_ns: int) -> None:
        """Break the line until then. Raises LinkFaultError if this link cannot."""

    def force_bus_off(self, who: str) -> None:
        """Put "host" or "robot" into bus-off. Raises LinkFaultError if this link cannot."""

    def babble(self, frame: Frame) -> None:
        """Let a further, faulty node send `frame` once. Raises LinkFaultError if this link cannot."""

    def tamper(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame. Raises LinkFaultError if the link is not its own."""

    def summary(self) -> str:
        """Counters in one line."""

    def close(self) -> None:
        """Release the medium; safe to call twice."""
