"""A transport from plain settings."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any, Literal

from can.interfaces import VALID_INTERFACES

from drivers.transport.can import CanMedium
from drivers.transport.reconnecting import ReconnectingTransport
from drivers.transport.serial import SerialMedium

SLCAN_BITRATES = (10_000, 20_000, 50_000, 83_300, 100_000, 125_000, 250_000, 500_000, 750_000, 1_000_000)
MUTE_AFTER_S = 4.0
MAY_STAY_MUTE = frozenset({"slcan", "serial", "seeedstudio", "robotell", "socketcand"})
"""Interfaces over a serial port or a connection: these can be open and lead nowhere."""
_FIELDS_OF_THEIR_OWN = ("interface", "channel", "bitrate", "ignore_config")
_NEEDED_OPTIONS = {"socketcand": ("host", "port")}
_PACKAGES = {
    "canalystii": ("canalystii", "canalystii"),
    "cantact": ("cantact", "cantact"),
    "gs_usb": ("gs_usb", "gs-usb"),
    "neovi": ("ics", "python-ics"),
    "udp_multicast": ("msgpack", "msgpack"),
}
"""By interface: the module that it imports, and the package that holds it."""


class TransportSettingsError(ValueError):
    """Settings that no device could satisfy; the message is one line: field, what is wrong, what to write."""


def make_transport(
    kind: Literal["can", "serial"],
    *,
    interface: str = "socketcan",
    channel: str = "can0",
    bitrate: int = 500_000,
    options: Mapping[str, Any] = MappingProxyType({}),
    port: str = "/dev/ttyUSB0",
    baud: int = 921_600,
    dtr: bool = False,
    rts: bool = False,
) -> ReconnectingTransport:
    """Make a link by the fields of robot.toml's [link]; it holds nothing before it is opened.

    Raises TransportSettingsError for a kind, interface, option or bit rate that does not exist, and for an interface
    whose Python package is not installed.
    """
    if kind == "serial":
        return ReconnectingTransport(SerialMedium(port, baud, dtr, rts), mute_after_s=MUTE_AFTER_S)
    if kind != "can":
        raise TransportSettingsError(f'link.kind: "{kind}" is no kind of link; write "can" or "serial"')
    _check_can(interface, bitrate, options)
    mute_after_s = MUTE_AFTER_S if interface in MAY_STAY_MUTE else None
    return ReconnectingTransport(CanMedium(interface, channel, bitrate, options), mute_after_s=mute_after_s)


def open_transport(kind: Literal["can", "serial"], **settings: Any) -> ReconnectingTransport:
    """Make a link as `make_transport` does, and open it; a device that is absent is waited for, not an error."""
    transport = make_transport(kind, **settings)
    transport.open()
    return transport


def _check_can(interface: str, bitrate: int, options: Mapping[str, Any]) -> None:
    if interface not in VALID_INTERFACES:
        known = ", ".join(sorted(VALID_INTERFACES))
        raise TransportSettingsError(f'link.interface: python-can has no interface "{interface}"; write one of {known}')
    if interface == "slcan" and bitrate not in SLCAN_BITRATES:
        known = ", ".join(map(str, SLCAN_BITRATES))
        raise TransportSettingsError(f"link.bitrate: slcan has no {bitrate} bit/s; write one of {known}")
    for name in _FIELDS_OF_THEIR_OWN:
        if name in options:
            raise TransportSettingsError(f"link.options: {name} has a field of its own; write it as link.{name}")
    missing = [name for name in _NEEDED_OPTIONS.get(interface, ()) if name not in options]
    if missing:
        raise TransportSettingsError(
            f"link.options: {interface} needs {' and '.join(missing)}; write options = "
            '{ host = "192.168.1.5", port = 29536 }'
        )
    module, package = _PACKAGES.get(interface, (None, ""))
    if module is not None and find_spec(module) is None:
        raise TransportSettingsError(
            f"link.interface: {interface} needs the Python package {package}, which is not installed; "
            f"run: pip install {package}"
        )
