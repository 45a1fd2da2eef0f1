"""A model that has every effect of motion, as kernels are compiled for it once; it needs nothing of `gap`."""

from __future__ import annotations

import math
from collections.abc import Mapping

from disco_hw.effects.registry import MOTION_EFFECTS, REGISTRY
from disco_hw.model import EffectSetting, Model


def model_with_every_effect(values: Mapping[str, Mapping[str, float]], base: tuple[float, float, float]) -> Model:
    """A model whose free run is kept, with these effects; all others are there too, and do nothing."""
    neutral = {
        name: {p.name: p.high if math.isinf(p.neutral) else p.neutral for p in REGISTRY[name].parameters}
        for name in MOTION_EFFECTS
    }
    return Model(*base, effects=tuple(EffectSetting(name, dict(of)) for name, of in (neutral | dict(values)).items()))
