"""Media that carry frames, one file a medium; every one reconnects by itself and counts what it drops."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from drivers.transport import can, serial
from drivers.transport.can import CanMedium
from drivers.transport.inprocess import InProcessTransport, connect_pair
from drivers.transport.reconnecting import ReconnectingTransport, TransportSettingsError
from drivers.transport.serial import SerialMedium

__all__ = [
    "MEDIA",
    "CanMedium",
    "InProcessTransport",
    "ReconnectingTransport",
    "SerialMedium",
    "TransportSettingsError",
    "connect_pair",
    "make_transport",
    "open_transport",
]

MEDIA: Mapping[str, Callable[..., ReconnectingTransport]] = MappingProxyType(
    {medium.KIND: medium.make_transport for medium in (can, serial)}
)
"""By `link.kind` of robot.toml: what makes a link of the fields of [link]; each takes its own and leaves the others."""


def make_transport(kind: str, **fields: Any) -> ReconnectingTransport:
    """Make a link by the fields of robot.toml's [link]; it holds nothing before it is opened.

    Raises TransportSettingsError for a kind that does not exist and for what its medium refuses.
    """
    medium = MEDIA.get(kind)
    if medium is None:
        known = " or ".join(f'"{name}"' for name in MEDIA)
        raise TransportSettingsError(f'link.kind: "{kind}" is no kind of link; write {known}')
    return medium(**fields)


def open_transport(kind: str, **fields: Any) -> ReconnectingTransport:
    """Make a link as `make_transport` does, and open it; a device that is absent is waited for, not an error."""
    transport = make_transport(kind, **fields)
    transport.open()
    return transport
