"""Motor controllers byte for byte, one file each under its driver's name, with the weaknesses of the real ones."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from sim.virtual_robot import Controller


def find_controller(driver: str) -> Callable[[Any, int], Controller] | None:
    """Return the factory of a driver's simulated controllers, called with its settings and the ticks a turn.

    None for a driver that has no file here.
    """
    name = f"{__name__}.{driver}"
    if not driver.isidentifier() or find_spec(name) is None:
        return None
    made: Callable[[Any, int], Controller] | None = getattr(import_module(name), "CONTROLLER", None)
    return made
