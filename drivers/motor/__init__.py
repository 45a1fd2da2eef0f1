"""Motor controllers, one file each, of which robot.toml's `link.driver` names one; see docs/add-a-motor-driver.md."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType

from drivers.types import Driver, MotorDriver


class UnknownDriverError(ValueError):
    """No driver has this name; the message lists the names that there are."""


@cache
def motor_drivers() -> Mapping[str, MotorDriver]:
    """By name: the `DRIVER` of each module in this folder that has one.

    Found when first asked for, not on import: an e-stop needs none of them.
    """
    modules = (import_module(each.name) for each in pkgutil.iter_modules(__path__, f"{__name__}."))
    found: list[MotorDriver] = [module.DRIVER for module in modules if hasattr(module, "DRIVER")]
    return MappingProxyType({driver.name: driver for driver in sorted(found, key=lambda driver: driver.name)})


def find_driver(name: str | None) -> MotorDriver:
    """Return the driver of this name, the default one for None. Raises UnknownDriverError for a name not known."""
    known = motor_drivers()
    if name is None:
        return next(driver for driver in known.values() if driver.is_default)
    if name not in known:
        raise UnknownDriverError(f'there is no driver "{name}"; write one of {", ".join(known)}')
    return known[name]


def make_driver(name: str | None, key: bytes | None = None) -> Driver:
    """Make the driver that `link.driver` names, the default one for None.

    `key` (16 bytes): of authenticated mode. Raises UnknownDriverError.
    """
    return find_driver(name).make(key)
