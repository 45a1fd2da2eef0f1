"""The virtual robot on the simulated CAN bus that its own process serves to others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from drivers.types import Frame, ReceivedFrame
from sim.bus import BusFault
from sim.hub import Hub
from sim.robot_link import LinkFaultError
from sim.robot_node import RobotNode


class HubLink:
    """A hub at `path` with the robot as a node; satisfies `sim.robot_link.RobotLink`.

    `log` gets a line for every frame on the bus, as candump writes it. Raises SocketPathError if the hub cannot listen.
    """

    def __init__(
        self,
        path: Path,
        now_ns: int,
        *,
        bitrate: int = 500_000,
        pacing: bool = True,
        log: Callable[[str], object] | None = None,
    ) -> None:
        self.hub = Hub(path, now_ns, bitrate=bitrate, pacing=pacing, log=log)
        self._robot = RobotNode(self.hub.bus)
        self.robot = self._robot.node

    @property
    def address(self) -> str:
        """The hub's socket."""
        return f"unixcan {self.hub.path}"

    @property
    def error_counters(self) -> tuple[int, int]:
        """Error counters of the robot's node; the first is 256 at bus-off."""
        return self._robot.error_counters

    def filenos(self) -> list[int]:
        """The hub's epoll descriptor."""
        return [self.hub.fileno()]

    def next_event_ns(self) -> int | None:
        """When a frame ends, a restart is due, or clients may come back."""
        times = [t for t in (self.hub.next_event_ns(), self._robot.restart_ns) if t is not None]
        return min(times) if times else None

    def collect(self, now_ns: int) -> int:
        """Serve the sockets."""
        return self.hub.collect(now_ns)

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Run the bus up to `now_ns`; return the data frames that the robot's controller has received."""
        return self._robot.take(now_ns, self.hub.advance(now_ns, admit))

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames; the node counts those that do not fit."""
        self._robot.send(frames)

    def unplug(self, until_ns: int) -> None:
        """Cut off all clients and refuse new ones until then."""
        self.hub.unplug(until_ns)

    def force_bus_off(self, who: str) -> None:
        """Put all clients ("host") or the robot's controller ("robot") into bus-off."""
        if who == "host":
            self.hub.force_clients_bus_off()
        elif who == "robot":
            self.hub.bus.force_bus_off(self.robot)
        else:
            raise LinkFaultError(f"bus_off {who}: say host or robot")

    def babble(self, frame: Frame) -> None:
        """Send `frame` from a third node; if its queue is full it is on the bus as often as the bus allows."""
        self._robot.babble(frame)

    def tamper(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame."""
        self.hub.bus.fault = fault

    def summary(self) -> str:
        """Counters in one line."""
        robot = self.robot
        return (
            f"{self.hub.stats} robot: sent={robot.sent} received={robot.received} full={robot.refused_full} "
            f"bus_off={robot.bus_off_count} error_frames={self.hub.bus.error_frames}"
        )

    def close(self) -> None:
        """Close the hub and remove its socket."""
        self.hub.close()
