"""Media that carry frames, one file a medium; every one reconnects by itself and counts what it drops."""

from drivers.transport.can import CanMedium
from drivers.transport.factory import TransportSettingsError, make_transport, open_transport
from drivers.transport.inprocess import InProcessTransport, connect_pair
from drivers.transport.reconnecting import ReconnectingTransport
from drivers.transport.serial import SerialMedium

__all__ = [
    "CanMedium",
    "InProcessTransport",
    "ReconnectingTransport",
    "SerialMedium",
    "TransportSettingsError",
    "connect_pair",
    "make_transport",
    "open_transport",
]
