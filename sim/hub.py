"""The simulated CAN bus between processes, in real time: a client of a Unix socket is a node on it.

Each packet on the socket is one Linux `struct can_frame`. Without threads: the owner waits on `filenos()` and
`next_event_ns()` and calls `collect` and `advance`.
"""

from __future__ import annotations

import select
import socket
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from drivers.private_files import bind_private
from drivers.types import Frame, ReceivedFrame
from sim import LinkFaultError, RobotNode
from sim.bus import BusFault, CanBus
from sim.can_protocol import (
    ECHO_OWN_FRAMES,
    FRAME_BYTES,
    BusNode,
    CanFrame,
    TransmitOrder,
    pack_frame,
    receive_overflow_frame,
    unpack_frame,
)

# Chosen: shallow, as of a CAN interface; the rest waits in the sender's socket.
CLIENT_TRANSMIT_QUEUE = 32
READER_QUEUE = 1024
"""Frames kept for a client that does not read, beyond the kernel's 280 or so; more are dropped and counted."""


@dataclass(slots=True)
class HubStats:
    """Counters since the hub was made; nothing is dropped without being counted here."""

    connections: int = 0
    frames_in: int = 0
    frames_out: int = 0
    reader_overflow: int = 0
    malformed: int = 0


@dataclass(slots=True, eq=False)
class _Client:
    connection: socket.socket
    node: BusNode
    events: int = select.EPOLLIN
    unread: deque[bytes] = field(default_factory=deque)
    lost_unread: int = 0
    unsent: int = 0


class Hub:
    """The bus with the robot and the clients as its nodes, and the socket at `path` through which clients come and go.

    Satisfies `sim.RobotLink`. Clients send in the order in which they wrote. A silent node acknowledges all frames, so
    that a lone node is not without an answer. `log` gets a line for every frame on the bus, as candump writes it.
    Raises SocketPathError if it cannot listen.
    """

    def __init__(
        self,
        path: Path,
        now_ns: int,
        *,
        bitrate: int = 500_000,
        log: Callable[[str], object] | None = None,
    ) -> None:
        self.path = path
        self.bus = CanBus(bitrate, log=log, start_ns=now_ns)
        self.bus.attach("monitor")
        self.robot = RobotNode(self.bus)
        self.stats = HubStats()
        self._now_ns = now_ns
        self._epoll = select.epoll()
        self._listener: socket.socket | None = None
        self._plug_in_ns: int | None = None
        self._clients: dict[int, _Client] = {}
        self._by_node: dict[BusNode, _Client] = {}
        self._leaving: list[_Client] = []
        self._inbox: deque[tuple[_Client, CanFrame]] = deque()
        self._listen()

    @property
    def address(self) -> str:
        """Address of the hub's socket."""
        return f"unixcan {self.path}"

    @property
    def error_counters(self) -> tuple[int, int]:
        """Error counters of the robot's node; the first is 256 at bus-off."""
        return self.robot.error_counters

    def filenos(self) -> list[int]:
        """Return the descriptor that is readable when a client has done something."""
        return [self._epoll.fileno()]

    def next_event_ns(self) -> int | None:
        """Return when a frame ends, a restart is due, or clients may come back; None if never."""
        times = [t for t in (self.bus.next_event_ns(), self._plug_in_ns, self.robot.restart_ns) if t is not None]
        return min(times) if times else None

    def collect(self, now_ns: int) -> int:
        """Read and write all sockets; return how many frames of clients now wait to be let onto the bus."""
        self._now_ns = now_ns
        if self._plug_in_ns is not None and now_ns >= self._plug_in_ns:
            self._plug_in_ns = None
            self._listen()
        for descriptor, events in self._epoll.poll(0):
            client = self._clients.get(descriptor)
            if client is None:
                self._accept()
                continue
            if events & select.EPOLLOUT:
                self._flush(client)
            if events & (select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR):
                self._read(client)
        self._set_events()
        return len(self._inbox)

    def advance(self, now_ns: int, admit: int | None = None) -> list[ReceivedFrame]:
        """Let the oldest `admit` waiting frames (None: all) onto the bus and run it up to `now_ns`.

        Returns the data frames that the robot's controller has received.
        """
        deliveries = self.bus.advance(now_ns)
        for _ in range(len(self._inbox) if admit is None else admit):
            client, frame = self._inbox.popleft()
            client.unsent -= 1
            self.bus.send(client.node, frame)
        deliveries.extend(self.bus.advance(now_ns))
        for delivery in deliveries:
            self._hand_out(delivery.frame, delivery.receivers)
        for client in [client for client in self._leaving if not client.unsent and not client.node.pending]:
            self._leaving.remove(client)
            self.bus.detach(client.node)
        self._set_events()
        return self.robot.take(now_ns, deliveries)

    def send(self, frames: Sequence[Frame]) -> None:
        """Queue the robot's frames; the node counts those that do not fit."""
        self.robot.send(frames)

    def unplug(self, until_ns: int) -> None:
        """Cut off all clients, with what they have not sent yet, and refuse new ones until `until_ns`."""
        for client in tuple(self._clients.values()):
            self._drop(client)
        for client in self._leaving:
            self.bus.detach(client.node)
        self._leaving.clear()
        if self._listener is not None:
            self._epoll.unregister(self._listener)
            self._listener.close()
            self._listener = None
            self.path.unlink(missing_ok=True)
        self._plug_in_ns = until_ns

    def force_bus_off(self, who: str) -> None:
        """Put all clients ("host") or the robot ("robot") into bus-off; a client that connects anew is out of it."""
        if who not in ("host", "robot"):
            raise LinkFaultError(f"bus_off {who}: say host or robot")
        for node in tuple(self._by_node) if who == "host" else (self.robot.node,):
            self.bus.force_bus_off(node)

    def babble(self, frame: Frame) -> None:
        """Send `frame` from a third node; if its queue is full it is on the bus as often as the bus allows."""
        self.robot.babble(frame)

    def set_bus_fault(self, fault: BusFault) -> None:
        """Let `fault` decide what becomes of each frame."""
        self.bus.fault = fault

    def summary(self) -> str:
        """Counters in one line."""
        robot = self.robot.node
        return (
            f"{self.stats} robot: sent={robot.sent} received={robot.received} full={robot.refused_full} "
            f"bus_off={robot.bus_off_count} error_frames={self.bus.error_frames}"
        )

    def close(self) -> None:
        """Close all connections and remove the socket; safe to call twice."""
        if not self._epoll.closed:
            self.unplug(self._now_ns)
            self._epoll.close()

    def _listen(self) -> None:
        self._listener = bind_private(self.path, socket.SOCK_SEQPACKET)
        self._epoll.register(self._listener, select.EPOLLIN)

    def _accept(self) -> None:
        if self._listener is None:
            return
        try:
            connection, _ = self._listener.accept()
        except (BlockingIOError, ConnectionAbortedError):
            # The client gave up while it waited; there is nothing to serve and nothing lost.
            return
        connection.setblocking(False)
        self.stats.connections += 1
        node = self.bus.attach(
            f"client{self.stats.connections}", capacity=CLIENT_TRANSMIT_QUEUE, order=TransmitOrder.FIFO
        )
        client = _Client(connection, node)
        self._clients[connection.fileno()] = client
        self._by_node[node] = client
        self._epoll.register(connection, select.EPOLLIN)

    def _read(self, client: _Client) -> None:
        """Take in frames of one client as far as its transmit queue has room: the rest waits with the sender."""
        while client.unsent + client.node.pending < CLIENT_TRANSMIT_QUEUE:
            try:
                packet = client.connection.recv(FRAME_BYTES + 1)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._drop(client)
                return
            if packet == ECHO_OWN_FRAMES:
                client.node.echo = True
                continue
            frame = unpack_frame(packet)
            if frame is None:
                self.stats.malformed += 1
                continue
            self.stats.frames_in += 1
            if frame.error:
                # No controller sends these; a test that writes one wants the others to read it.
                self._hand_out(frame, tuple(node for node in self._by_node if node is not client.node))
                continue
            client.unsent += 1
            self._inbox.append((client, frame))

    def _hand_out(self, frame: CanFrame, receivers: tuple[BusNode, ...]) -> None:
        packet = pack_frame(frame)
        for node in receivers:
            client = self._by_node.get(node)
            if client is None:
                continue
            if len(client.unread) >= READER_QUEUE:
                client.lost_unread += 1
                self.stats.reader_overflow += 1
                continue
            was_empty = not client.unread
            if client.lost_unread:
                client.unread.append(pack_frame(receive_overflow_frame()))
                client.lost_unread = 0
            client.unread.append(packet)
            if was_empty:
                self._flush(client)

    def _flush(self, client: _Client) -> None:
        while client.unread:
            try:
                client.connection.send(client.unread[0])
            except BlockingIOError:
                return
            except OSError:
                # The client is gone; its hang-up event follows and ends it there.
                client.unread.clear()
                return
            client.unread.popleft()
            self.stats.frames_out += 1

    def _set_events(self) -> None:
        """Listen only to what can be served now, or a level-triggered poll would spin."""
        for descriptor, client in self._clients.items():
            room = client.unsent + client.node.pending < CLIENT_TRANSMIT_QUEUE
            events = select.EPOLLIN if room else 0
            if client.unread:
                events |= select.EPOLLOUT
            if events != client.events:
                client.events = events
                self._epoll.modify(descriptor, events)

    def _drop(self, client: _Client) -> None:
        self._epoll.unregister(client.connection)
        del self._clients[client.connection.fileno()]
        del self._by_node[client.node]
        client.connection.close()
        self._leaving.append(client)
