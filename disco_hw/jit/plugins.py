"""Effects that other packages bring along: modules named by entry points of the group `disco_hw.effects`."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

GROUP = "disco_hw.effects"


@cache
def plugin_modules() -> tuple[str, ...]:
    """Names of the modules, each with an `EFFECT` and its `term`, sorted."""
    return tuple(sorted({point.module for point in entry_points(group=GROUP)}))


def plugin_sources() -> tuple[Path, ...]:
    """Their files, for whoever keeps compiled code; raises ModuleNotFoundError for a module that is not there."""
    found = []
    for module in plugin_modules():
        spec = find_spec(module)
        if spec is None or spec.origin is None:
            raise ModuleNotFoundError(f"{module}: named as an effect by an installed package, but not there")
        found.append(Path(spec.origin))
    return tuple(found)
