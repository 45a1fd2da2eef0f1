"""The amended model: nominal geometry refitted, missing effects added, joint uncertainty of old and new parameters."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from disco_hw.gap.intervals import Estimate, Estimates
from disco_hw.model import EffectSetting, Gaussian, Model
from disco_hw.model.effects import REGISTRY
from disco_hw.model.parameter import BASE_PARAMETERS

Array = NDArray[np.float64]


def amended_model(
    model: Model, effects: Mapping[str, Mapping[str, Estimate]], parts: tuple[Estimates, ...]
) -> tuple[Model, tuple[str, ...]]:
    """The model with base parameters of `parts`, `effects` added, and their joint Gaussian; and notes for a person.

    Values outside an effect's physical range are put at its end, with a note.
    """
    notes: list[str] = []
    estimates = {name: estimate for part in parts for name, estimate in part.by_name.items()}
    settings = []
    for name, values in effects.items():
        known = {parameter.name: parameter for parameter in REGISTRY[name].parameters}
        inside = {}
        for key, parameter in known.items():
            value = values[key].value if key in values else parameter.neutral
            inside[key] = min(max(value, parameter.low), parameter.high)
            if inside[key] != value:
                notes.append(f"{name}.{key}: {value:.4g} is outside what the model takes; {inside[key]:.4g} is written")
        settings.append(EffectSetting(name, inside))
    base = {p.name: estimates[p.name].value for p in BASE_PARAMETERS if p.name in estimates}
    bare = Model(
        **{p.name: base.get(p.name, getattr(model, p.name)) for p in BASE_PARAMETERS},
        effects=tuple(settings),
        name=model.name,
    )
    names, covariance = _joint(bare, effects, estimates, parts)
    if not names:
        return bare, tuple(notes)
    point = dict(zip(bare.parameter_names, bare.point(), strict=True))
    belief = Gaussian(names, np.array([point[name] for name in names]), covariance)
    return Model(bare.wheel_radius_m, bare.axial_distance_m, bare.x_icr_m, bare.effects, belief, bare.name), tuple(
        notes
    )


def _joint(
    bare: Model,
    effects: Mapping[str, Mapping[str, Estimate]],
    estimates: Mapping[str, Estimate],
    parts: tuple[Estimates, ...],
) -> tuple[tuple[str, ...], Array]:
    """Names and covariance: joint within a channel, independent between channels."""
    full = {f"{effect}.{key}": estimate for effect, values in effects.items() for key, estimate in values.items()}
    known = {p.name: estimates[p.name] for p in BASE_PARAMETERS if p.name in estimates} | full
    names = tuple(name for name in bare.parameter_names if name in known)
    covariance = np.diag([known[name].deviation ** 2 for name in names])
    for part in parts:
        order = {name: place for place, name in enumerate(part.fitted)}
        for i, first in enumerate(names):
            for j, second in enumerate(names):
                if i != j and first in order and second in order:
                    covariance[i, j] = part.covariance[order[first], order[second]]
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    sound = (vectors * np.maximum(values, 1e-8)) @ vectors.T * np.outer(scale, scale)
    return names, np.asarray(0.5 * (sound + sound.T))
