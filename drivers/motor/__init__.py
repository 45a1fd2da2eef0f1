"""Motor controllers, one file each, of which robot.toml's `link.driver` names one; see docs/add-a-motor-driver.md."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any

from drivers.types import Driver, MotorDriver

DEFAULT = "reference"


class UnknownDriverError(ValueError):
    """No driver has this name; the message lists the names that there are."""


class DriverFieldError(ValueError):
    """A field of [link] that belongs to another driver than the one named."""

    def __init__(self, field: str, fault: str) -> None:
        super().__init__(f"{field}: {fault}")
        self.field, self.fault = field, fault


@cache
def motor_drivers() -> Mapping[str, MotorDriver]:
    """By name: the `DRIVER` of each module in this folder that has one.

    Found when first asked for, not on import: `find_driver` reads the one that is asked for, and an e-stop no other.
    """
    modules = (import_module(f"{__name__}.{name}") for name in _module_names())
    found: list[MotorDriver] = [module.DRIVER for module in modules if hasattr(module, "DRIVER")]
    return MappingProxyType({driver.name: driver for driver in sorted(found, key=lambda driver: driver.name)})


def find_driver(name: str | None) -> MotorDriver:
    """Return the driver of this name, the default one for None. Raises UnknownDriverError for a name not known."""
    asked = DEFAULT if name is None else name
    module = import_module(f"{__name__}.{asked}") if asked in _module_names() else None
    found: MotorDriver | None = getattr(module, "DRIVER", None)
    if found is None:
        raise UnknownDriverError(f'there is no driver "{name}"; write one of {", ".join(motor_drivers())}')
    return found


def _module_names() -> list[str]:
    """The modules of this folder; a driver's has its name."""
    return [each.name for each in pkgutil.iter_modules(__path__)]


def make_driver(name: str | None, settings: Any = None, key: bytes | None = None) -> Driver:
    """Make the driver that `link.driver` names, the default one for None.

    `settings`: of its type, None for its defaults. `key` (16 bytes): of authenticated mode. Raises UnknownDriverError.
    """
    found = find_driver(name)
    return found.make(found.settings() if settings is None else settings, key)


def own_fields(name: str | None, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Those of [link]'s fields that are the driver's own. Raises DriverFieldError for one of another driver's."""
    found = find_driver(name)
    own = {field: value for field, value in fields.items() if field in found.settings.__struct_fields__}
    others = motor_drivers().values() if len(own) < len(fields) else ()
    for other in others:
        for field in fields:
            if field in other.settings.__struct_fields__ and field not in own:
                raise DriverFieldError(field, f"a field of the driver {other.name}, and link.driver is {found.name}")
    return own
