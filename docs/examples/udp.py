"""One frame in each datagram: two bytes of identifier, little-endian, then the data."""

import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from drivers.transport.reconnecting import Connection, ReconnectingTransport, TransportCounters, TransportSettingsError
from drivers.types import Frame, ReceivedFrame
from firmware_protocol.serial_framing import MAX_CAN_ID, MAX_DATA

KIND = "udp"


def create_transport(*, channel: str, **_of_other_media: Any) -> ReconnectingTransport:
    """By the fields of [link], not yet opened. Raises TransportSettingsError for an address that cannot be one."""
    host, _, port = channel.rpartition(":")
    if not (host and port.isdigit() and int(port) < 65536):
        raise TransportSettingsError(f'link.channel: "{channel}" is no address; write host:port')
    return ReconnectingTransport(UdpMedium(host, int(port)), mute_after_s=4.0)


@dataclass(frozen=True, slots=True)
class UdpMedium:
    """How to connect to one address."""

    host: str
    port: int

    @property
    def name(self) -> str:
        return f"udp {self.host}:{self.port}"

    def connect(self, counters: TransportCounters) -> Connection:
        """Connect. Raises OSError; it is tried again, with a pause that doubles."""
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.connect((self.host, self.port))
        opened.settimeout(0.1)
        return UdpConnection(opened, counters)

    def explain(self, error: Exception) -> str:
        """One line for a person: what is wrong and what to do."""
        return f"{self.name}: {error}; is the controller switched on, and is this its address?"


class UdpConnection:
    """One thread reads while another writes."""

    def __init__(self, opened: socket.socket, counters: TransportCounters) -> None:
        self._socket = opened
        self._counters = counters

    def read(self) -> Sequence[ReceivedFrame]:
        """Wait 0.1 s at most for a frame. Raises OSError when the link is lost."""
        try:
            datagram = self._socket.recv(2048)
        except TimeoutError:
            return ()
        can_id = int.from_bytes(datagram[:2], "little")
        if not 2 <= len(datagram) <= 2 + MAX_DATA or can_id > MAX_CAN_ID:
            self._counters.add(malformed=1)
            return ()
        return (ReceivedFrame(time.monotonic_ns(), Frame(can_id, datagram[2:])),)

    def write(self, frame: Frame) -> None:
        """Send in bounded time. Raises OSError when the link is lost."""
        self._socket.send(frame.can_id.to_bytes(2, "little") + frame.data)

    def close(self) -> None:
        self._socket.close()
