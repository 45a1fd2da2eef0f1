"""Foreign logs -> our MCAP log: the formats, each a module here with a `FORMAT`, told apart by their first bytes."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from disco_hw.config import RobotConfig
from disco_hw.log.drive import DriveLog

LONGEST_BEGIN_BYTES = 64


@dataclass(frozen=True, slots=True)
class LogFormat:
    """One format: `recognises` says of the first bytes of a file (64 at most) whether it is this one.

    `read` takes path and robot.toml and returns the arrays of the drive; it raises LogError with one line
    that names the file, the place and the remedy. Of two formats that recognise a file the one with the lower `order`
    reads it; one that takes whatever is left comes last. `has_topics`: [ros2] and `--topic` say what of it is read.
    """

    name: str
    recognises: Callable[[bytes], bool]
    read: Callable[[Path, RobotConfig], DriveLog]
    order: int = 100
    has_topics: bool = False


@cache
def log_formats() -> tuple[LogFormat, ...]:
    """All formats, in the order in which they are asked."""
    names = [module.name for module in pkgutil.iter_modules(__path__)]
    modules = [importlib.import_module(f"{__name__}.{name}") for name in names]
    found = [module.FORMAT for module in modules if hasattr(module, "FORMAT")]
    return tuple(sorted(found, key=lambda each: (each.order, each.name)))


def format_of(begin: bytes) -> LogFormat | None:
    """The format of a file that begins with these bytes, None if it is none of them."""
    return next((each for each in log_formats() if each.recognises(begin)), None)
