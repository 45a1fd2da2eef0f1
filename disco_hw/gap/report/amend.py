"""Creation of the amended model: refitted geometry, added effects, joint uncertainty of old and new parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from disco_hw.effects import Stage
from disco_hw.gap.search.analysis import FinalFit, GapAnalysis
from disco_hw.gap.search.channel_result import ChannelEstimates, ParameterEstimate, UnnamedTerm
from disco_hw.gap.search.end_to_end import Freed, JointFit, Part
from disco_hw.gap.search.unnamed_terms import Term
from disco_hw.model import EffectSetting, Gaussian, Model
from disco_hw.model.model import BASE_PARAMETERS, within_ranges
from disco_hw.model.terms import REACH, TERMS, effect_of

Array = NDArray[np.float64]


def channel_estimates(analysis: GapAnalysis, final: FinalFit) -> tuple[ChannelEstimates, ...]:
    """Estimates of the channels, body first, with the unnamed terms under their names in a model."""
    both = ((analysis.body, final.final_body_estimates), (analysis.wheels, final.wheel_estimates))
    return tuple(
        with_terms_named(part, found.unnamed, _geometry(final))
        for found, part in both
        if found is not None and part is not None
    )


def at_joint_fit(part: ChannelEstimates, own_part: Part, of: Freed, joint: JointFit) -> ChannelEstimates:
    """Move a channel's estimates to those of the fit of the whole chain, and widen their intervals by as much.

    What the whole chain frees of the channel (`own_part`) beyond what was found in it comes with its own variance.
    """
    by_name, off = dict(part.by_name), np.zeros(len(part.fitted))
    for name, old in part.by_name.items():
        value = joint.value(name, of, own_part)
        if value is None:
            continue
        deviation = float(np.hypot(old.deviation, value - old.value))
        by_name[name] = ParameterEstimate.around(value, deviation)
        if name in part.fitted:
            off[part.fitted.index(name)] = value - old.value
    new = [name for name in (own_part.layout.columns[place] for place in own_part.active) if name not in by_name]
    places = [joint.names.index(name) for name in new]
    added = joint.covariance[np.ix_(places, places)]
    for name, variance in zip(new, np.diag(added), strict=True):
        by_name[name] = ParameterEstimate.around(joint.value(name, of, own_part) or 0.0, float(variance) ** 0.5)
    covariance = block_diag(part.covariance + np.diag(off**2), added) if new else part.covariance + np.diag(off**2)
    return ChannelEstimates(by_name, (*part.fitted, *new), covariance)


def simple_model(model: Model, of: Freed, joint: JointFit) -> tuple[Model, tuple[str, ...]]:
    """Return the model with the geometry and effects of a joint fit and their joint Gaussian, and notes."""
    by_name = {}
    for name, variance in zip(joint.names, np.diag(joint.covariance).tolist(), strict=True):
        value = joint.value(name, of)
        assert value is not None
        by_name[name] = ParameterEstimate.around(value, variance**0.5)
    named = [setting.name for setting in model.effects if setting.name not in TERMS]
    named += [name.partition(".")[0] for name in joint.names if "." in name]
    effects = {}
    for name in dict.fromkeys(named):
        effects[name] = {
            p.name: estimate
            for p in effect_of(name).parameters
            if (estimate := by_name.get(f"{name}.{p.name}", _given(model, name, p.name))) is not None
        }
    return amended_model(model, effects, {}, (ChannelEstimates(by_name, joint.names, joint.covariance),))


def _given(model: Model, name: str, key: str) -> ParameterEstimate | None:
    """Return a parameter that was not fitted as the model has it; None if the model lacks its effect."""
    values = [setting.values[key] for setting in model.effects if setting.name == name]
    return ParameterEstimate(values[0], values[0], values[0]) if values else None


def _geometry(final: FinalFit) -> tuple[float, float]:
    """Wheel radius and axial distance (m) as they were fitted; 1 where no poses tell."""
    body = final.final_body
    return (1.0, 1.0) if body is None else (float(body.vector[0]), float(body.vector[1]))


def carried_terms(analysis: GapAnalysis, final: FinalFit) -> dict[str, float]:
    """By name the accepted unnamed terms that a model can carry, and the largest size that their features had."""
    terms = [one.term for each in analysis.channels for one in each.unnamed]
    return {
        term.model_name: float(np.abs(term.perturbation).max()) / _rescaled(term, _geometry(final))
        for term in terms
        if term.model_name is not None
    }


def _rescaled(term: Term, geometry: tuple[float, float]) -> float:
    """Factor of a term's number with speeds that wheels of `geometry` make."""
    assert term.model_name is not None
    old_radius, old_axial = term.geometry
    return TERMS[term.model_name].rescaled(geometry[0] / old_radius, geometry[1] / old_axial)


def with_terms_named(
    part: ChannelEstimates, unnamed: Sequence[UnnamedTerm], geometry: tuple[float, float]
) -> ChannelEstimates:
    """Return a channel's estimates with the coefficients of its unnamed terms under their names in a model.

    They are put in units of the speeds that wheels of the final `geometry` (radius, axial distance, m) make.
    """
    names, factors = list(part.fitted), np.ones(len(part.fitted))
    by_name = dict(part.by_name)
    for number, found in enumerate(unnamed):
        name, column = found.term.model_name, f"term{number}"
        if name is None or column not in names:
            continue
        place = names.index(column)
        factor = _rescaled(found.term, geometry)
        names[place], factors[place] = f"{name}.k", factor
        old = by_name.pop(column)
        by_name[f"{name}.k"] = ParameterEstimate(old.value * factor, old.low * factor, old.high * factor)
    return ChannelEstimates(by_name, tuple(names), part.covariance * np.outer(factors, factors))


def amended_model(
    model: Model,
    effects: Mapping[str, Mapping[str, ParameterEstimate]],
    terms: Mapping[str, float],
    parts: tuple[ChannelEstimates, ...],
) -> tuple[Model, tuple[str, ...]]:
    """Return the model with base parameters of `parts`, `effects`, `terms` and their joint Gaussian, and notes.

    `terms` has by name how far each reaches. Terms that the model has already stay, with what was believed of them, and
    reach no less far. Values outside an effect's physical range are put at its end, with a note. A time below a
    millisecond is none: such a delay or lag is left out.
    """
    notes: list[str] = []
    estimates = {name: estimate for part in parts for name, estimate in part.by_name.items()}
    base = {p.name: estimates[p.name].value for p in BASE_PARAMETERS if p.name in estimates}
    known, reach = _known_terms(model, base)
    for name, largest in terms.items():
        found, before = estimates[f"{name}.k"], known[name].value if name in known else 0.0
        known[name] = ParameterEstimate(before + found.value, before + found.low, before + found.high)
        reach[name] = max(largest, reach.get(name, 0.0))
    kept = {name: values for name, values in effects.items() if not _takes_no_time(name, values)}
    kept |= {name: {"k": estimate} for name, estimate in known.items()}
    settings = []
    for name, values in kept.items():
        inside = {}
        for parameter in effect_of(name).parameters:
            key = parameter.name
            value = values[key].value if key in values else reach.get(name, parameter.neutral)
            inside[key] = min(max(value, parameter.low), parameter.high)
            if inside[key] != value:
                notes.append(f"{name}.{key}: {value:.4g} is outside what the model takes; {inside[key]:.4g} is written")
        settings.append(EffectSetting(name, inside))
    bare = Model(
        **{p.name: base.get(p.name, getattr(model, p.name)) for p in BASE_PARAMETERS},
        effects=tuple(settings),
        name=model.name,
    )
    names, covariance = _joint(bare, kept, estimates, parts)
    if not names:
        return bare, tuple(notes)
    point = dict(zip(bare.parameter_names, bare.point(), strict=True))
    covariance = within_ranges(covariance, [bare.parameters[name] for name in names])
    belief = Gaussian(names, np.array([point[name] for name in names]), covariance)
    return replace(bare, belief=belief), tuple(notes)


# Chosen: a shorter delay or lag is none that a controller could feel.
_LEAST_TIME_S = 1e-3


def _takes_no_time(name: str, values: Mapping[str, ParameterEstimate]) -> bool:
    """Whether an effect that is a time alone is shorter than anything that a robot's loop resolves."""
    effect = effect_of(name)
    is_time = effect.delayed_by is not None or effect.stage is Stage.POSE_TIME
    return is_time and all(abs(values[p.name].value) < _LEAST_TIME_S for p in effect.parameters if p.name in values)


def _known_terms(model: Model, base: Mapping[str, float]) -> tuple[dict[str, ParameterEstimate], dict[str, float]]:
    """Return the terms of a model with their intervals, and their reach, in units of the refitted `base`."""
    ratios = [
        base.get(name, getattr(model, name)) / getattr(model, name) for name in ("wheel_radius_m", "axial_distance_m")
    ]
    found, reach = {}, {}
    for setting in model.effects:
        if setting.name not in TERMS:
            continue
        factor, key = TERMS[setting.name].rescaled(*ratios), f"{setting.name}.k"
        deviation = 0.0
        if model.belief is not None and key in model.belief.names:
            place = model.belief.names.index(key)
            deviation = abs(factor) * float(model.belief.covariance()[place, place]) ** 0.5
        found[setting.name] = ParameterEstimate.around(setting.values["k"] * factor, deviation)
        reach[setting.name] = min(setting.values[REACH.name] / factor, REACH.neutral)
    return found, reach


def _joint(
    bare: Model,
    effects: Mapping[str, Mapping[str, ParameterEstimate]],
    estimates: Mapping[str, ParameterEstimate],
    parts: tuple[ChannelEstimates, ...],
) -> tuple[tuple[str, ...], Array]:
    """Return names and covariance of the parameters: joint within a channel, independent between channels."""
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
