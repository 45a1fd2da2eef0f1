"""Media that carry frames, one file a medium; every one reconnects by itself and counts what it drops."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any

from drivers.transport.can import CanMedium
from drivers.transport.inprocess import InProcessTransport, connect_pair
from drivers.transport.reconnecting import ReconnectingTransport, TransportSettingsError
from drivers.transport.serial import SerialMedium


@cache
def media() -> Mapping[str, Callable[..., ReconnectingTransport]]:
    """Return the `create_transport` of each module in this folder that has a `KIND`, by `link.kind` of robot.toml.

    It makes a link of the fields of [link], of which it takes its own and leaves the others.
    """
    modules = (import_module(each.name) for each in pkgutil.iter_modules(__path__, f"{__name__}."))
    return MappingProxyType({module.KIND: module.create_transport for module in modules if hasattr(module, "KIND")})


def create_transport(kind: str, **fields: Any) -> ReconnectingTransport:
    """Make a link by the fields of robot.toml's [link]; it holds nothing before it is opened.

    Raises TransportSettingsError for a kind that does not exist and for what its medium refuses.
    """
    medium = media().get(kind)
    if medium is None:
        known = " or ".join(f'"{name}"' for name in media())
        raise TransportSettingsError(f'link.kind: "{kind}" is not a kind of link; write {known}')
    return medium(**fields)


def open_transport(kind: str, **fields: Any) -> ReconnectingTransport:
    """Make a link as `create_transport` does, and open it; a device that is absent is waited for, not an error."""
    transport = create_transport(kind, **fields)
    transport.open()
    return transport
