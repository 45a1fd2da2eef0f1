"""All effects that a model can gain: `EFFECT` of every module beside this one.

So is one of another package that names it in the entry-point group `disco_hw.effects`.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from importlib import import_module
from types import MappingProxyType

from disco_hw import effects
from disco_hw.effects import STAGE_GROUPS, Effect, Stage
from disco_hw.errors import InputError
from disco_hw.jit import plugin_modules


def _discover() -> dict[str, Effect]:
    submodules = (import_module(each.name) for each in pkgutil.iter_modules(effects.__path__, f"{effects.__name__}."))
    found: dict[str, Effect] = {module.EFFECT.name: module.EFFECT for module in submodules if hasattr(module, "EFFECT")}
    delayed_by = next(name for name, effect in found.items() if effect.stage is Stage.DELAY)
    for name in plugin_modules():
        effect = _of_plugin(name)
        if effect.name in found:
            raise InputError(f"{name}: an effect {effect.name!r} already exists; give it another name")
        if effect.stage is Stage.DELAY:
            raise InputError(f"{name}: a model has one delay, {delayed_by!r}; choose another stage for {effect.name!r}")
        found[effect.name] = effect
    return dict(sorted(found.items()))


def _of_plugin(name: str) -> Effect:
    try:
        effect = getattr(import_module(name), "EFFECT", None)
    except Exception as error:
        raise InputError(
            f"{name}: an effect that cannot be loaded ({error}); repair or uninstall its package"
        ) from error
    if not isinstance(effect, Effect):
        raise InputError(f"{name}: holds no EFFECT of the type Effect; docs/add-an-effect.md shows one")
    return effect


REGISTRY: Mapping[str, Effect] = MappingProxyType(_discover())
# Names of the effects that a step has to do with.
MOTION_EFFECTS: tuple[str, ...] = tuple(name for name, effect in REGISTRY.items() if effect.moves)


def in_stages(*stages: Stage) -> tuple[Effect, ...]:
    """Return the effects of some stages, in the order in which they act."""
    group = {stage: place for place, stages in enumerate(STAGE_GROUPS) for stage in stages}
    chosen = [effect for effect in REGISTRY.values() if effect.stage in stages]
    return tuple(sorted(chosen, key=lambda effect: (group[effect.stage], effect.order)))


# The one effect that holds commands back.
(DELAY,) = in_stages(Stage.DELAY)
