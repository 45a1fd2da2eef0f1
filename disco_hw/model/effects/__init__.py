"""The effects a model can gain, one file each; a module of this package with an `EFFECT` is found by itself."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

from disco_hw.model.effects.effect import Channel, Effect

__all__ = ["MOTION_EFFECTS", "REGISTRY", "Channel", "Effect"]


def _discover() -> dict[str, Effect]:
    modules = (import_module(f"{__name__}.{found.name}") for found in pkgutil.iter_modules(__path__))
    effects = [module.EFFECT for module in modules if hasattr(module, "EFFECT")]
    return {effect.name: effect for effect in sorted(effects, key=lambda effect: effect.name)}


REGISTRY: Mapping[str, Effect] = MappingProxyType(_discover())
MOTION_EFFECTS: tuple[str, ...] = tuple(name for name, effect in REGISTRY.items() if effect.moves)
