"""A transport from plain settings."""

from __future__ import annotations

from typing import Any, Literal

from can.interfaces import VALID_INTERFACES

from drivers.transport.can import CanMedium
from drivers.transport.reconnecting import ReconnectingTransport
from drivers.transport.serial import SerialMedium

SLCAN_BITRATES = (10_000, 20_000, 50_000, 83_300, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000)


class TransportSettingsError(ValueError):
    """Settings that no device could satisfy; the message is one line: field, what is wrong, what to write."""


def make_transport(
    kind: Literal["can", "serial"],
    *,
    interface: str = "socketcan",
    channel: str = "can0",
    bitrate: int = 500_000,
    port: str = "/dev/ttyUSB0",
    baud: int = 921_600,
) -> ReconnectingTransport:
    """Make a link by the fields of robot.toml's [link]; it holds nothing before it is opened.

    Raises TransportSettingsError for a kind, interface or bit rate that does not exist.
    """
    return ReconnectingTransport(
        SerialMedium(port, baud) if kind == "serial" else _can_medium(kind, interface, channel, bitrate)
    )


def open_transport(kind: Literal["can", "serial"], **settings: Any) -> ReconnectingTransport:
    """Make a link as `make_transport` does, and open it; a device that is absent is waited for, not an error."""
    transport = make_transport(kind, **settings)
    transport.open()
    return transport


def _can_medium(kind: str, interface: str, channel: str, bitrate: int) -> CanMedium:
    if kind != "can":
        raise TransportSettingsError(f'link.kind: "{kind}" is no kind of link; write "can" or "serial"')
    if interface not in VALID_INTERFACES:
        known = ", ".join(sorted(VALID_INTERFACES))
        raise TransportSettingsError(f'link.interface: python-can has no interface "{interface}"; write one of {known}')
    if interface == "slcan" and bitrate not in SLCAN_BITRATES:
        known = ", ".join(map(str, SLCAN_BITRATES))
        raise TransportSettingsError(f"link.bitrate: slcan has no {bitrate} bit/s; write one of {known}")
    return CanMedium(interface, channel, bitrate)
