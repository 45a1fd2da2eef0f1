"""All effects that a model can gain: every module beside this one that has an `EFFECT`, found by itself.

So is one of another package that names it in the entry-point group `disco_hw.effects`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import Any

from disco_hw import effects
from disco_hw.effects.effect import Effect, Stage
from disco_hw.jit.plugins import plugin_modules


def _discover() -> dict[str, tuple[Effect, Any]]:
    beside = (found.name for found in pkgutil.iter_modules(effects.__path__, f"{effects.__name__}."))
    modules = [module for module in map(import_module, (*beside, *plugin_modules())) if hasattr(module, "EFFECT")]
    return {module.EFFECT.name: (module.EFFECT, module) for module in sorted(modules, key=lambda m: str(m.EFFECT.name))}


_FOUND = _discover()
REGISTRY: Mapping[str, Effect] = MappingProxyType({name: effect for name, (effect, _) in _FOUND.items()})
MOTION_EFFECTS: tuple[str, ...] = tuple(name for name, effect in REGISTRY.items() if effect.moves)
# The compiled functions that make up a step, in the order in which they act.
STEP_TERMS: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {
        name: module.term
        for name, (effect, module) in sorted(_FOUND.items(), key=lambda item: item[1][0].order)
        if effect.stage is not Stage.ELSEWHERE
    }
)
