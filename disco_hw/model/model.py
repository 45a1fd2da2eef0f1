"""A model: base parameters, the effects it has, and what is believed of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from disco_hw import config
from disco_hw.effects.effect import Effect, Parameter
from disco_hw.effects.registry import MOTION_EFFECTS, REGISTRY
from disco_hw.files import nearest
from disco_hw.model.belief import Belief, Uniform
from disco_hw.model.coefficients import Base, Coefficients, Effects, TermCoefficients
from disco_hw.model.terms import COMMAND, TERMS, effect_of, table_entry

WHEEL_RADIUS = Parameter("wheel_radius_m", "m", 0.005, 2.0, 0.06, neutral=0.06)
AXIAL_DISTANCE = Parameter("axial_distance_m", "m", 0.02, 5.0, 0.4, neutral=0.4)
X_ICR = Parameter("x_icr_m", "m", -2.0, 2.0, 0.0)

BASE_PARAMETERS = (WHEEL_RADIUS, AXIAL_DISTANCE, X_ICR)


Array = NDArray[np.float64]


@dataclass(frozen=True)
class EffectSetting:
    """An effect that a model has, with the values of its parameters.

    Raises ValueError for an unknown effect, missing or unknown parameters, or values outside their physical range.
    """

    name: str
    values: Mapping[str, float]

    def __post_init__(self) -> None:
        if self.name not in REGISTRY and self.name not in TERMS:
            near = nearest(self.name, REGISTRY)
            raise ValueError(
                f"unknown effect {self.name!r}; {f'did you mean {near}? ' if near else ''}known are "
                f"{', '.join(REGISTRY)}, and terms such as 'v_x += k v^3'"
            )
        expected = [parameter.name for parameter in self.effect.parameters]
        for given in self.values:
            if given not in expected:
                raise ValueError(f"{self.name}.{given}: no such parameter; {self.name} has {', '.join(expected)}")
        for parameter in self.effect.parameters:
            if parameter.name not in self.values:
                raise ValueError(f"{self.name}.{parameter.name}: missing; add its value in {parameter.unit}")
            _check_range(f"{self.name}.{parameter.name}", parameter, self.values[parameter.name])
        ordered = {name: float(self.values[name]) for name in expected}
        object.__setattr__(self, "values", MappingProxyType(ordered))

    @property
    def effect(self) -> Effect:
        """The effect itself."""
        return effect_of(self.name)


def _check_range(name: str, parameter: Parameter, value: float) -> None:
    if not parameter.low <= value <= parameter.high:
        raise ValueError(
            f"{name}: {value} is outside [{parameter.low}, {parameter.high}] {parameter.unit}; write a value inside it"
        )


@dataclass(frozen=True)
class Model:
    """The transition function's parameters and what is believed of them.

    `base` and `effects` hold the point values; `belief` is a joint distribution over any of `parameter_names`, and
    parameters it does not name are known exactly. `missing_effects` names effects of the robot that the model is known
    to lack, so that its parameters may have absorbed them. Raises ValueError for repeated effects, values outside their
    physical range, a belief over parameters that the model does not have or with a mean outside theirs, or a missing
    effect that is unknown or there.
    """

    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float = 0.0
    effects: tuple[EffectSetting, ...] = ()
    belief: Belief | None = None
    name: str = "robot"
    missing_effects: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for parameter in BASE_PARAMETERS:
            _check_range(parameter.name, parameter, getattr(self, parameter.name))
        names = [setting.name for setting in self.effects]
        for effect in names:
            if names.count(effect) > 1:
                raise ValueError(f"effect {effect!r} is listed twice; keep one")
        for effect in self.missing_effects:
            if effect not in REGISTRY:
                raise ValueError(f"missing_effects: unknown effect {effect!r}; known are {', '.join(REGISTRY)}")
            if effect in names:
                raise ValueError(f"missing_effects: {effect!r} is among the effects; take it out of one of them")
        if self.belief is not None:
            for believed in self.belief.names:
                if believed not in self.parameter_names:
                    raise ValueError(
                        f"belief over {believed!r}, which this model does not have; "
                        f"it has {', '.join(self.parameter_names)}"
                    )
                if self.belief.names.count(believed) > 1:
                    raise ValueError(f"belief names {believed!r} twice; keep one")
            for believed, mean in zip(self.belief.names, self.belief.mean().tolist(), strict=True):
                _check_range(f"belief: mean of {believed}", self.parameters[believed], mean)

    @classmethod
    def nominal(cls, robot: config.Robot, prior: config.Prior | None = None) -> Model:
        """The geometry of robot.toml without effects; with a prior, that uniform prior is the belief."""
        belief = None
        if prior is not None:
            ranges = {parameter.name: getattr(prior, parameter.name) for parameter in BASE_PARAMETERS}
            belief = Uniform(
                tuple(ranges),
                np.array([low for low, _ in ranges.values()]),
                np.array([high for _, high in ranges.values()]),
            )
        return cls(robot.wheel_radius_m, robot.axial_distance_m, robot.x_icr_m, belief=belief, name=robot.name)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """Every parameter by its full name: the base ones, then `effect.parameter`."""
        found = {parameter.name: parameter for parameter in BASE_PARAMETERS}
        for setting in self.effects:
            found |= {f"{setting.name}.{parameter.name}": parameter for parameter in setting.effect.parameters}
        return found

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Full names of all parameters, in the order of every parameter vector."""
        return tuple(self.parameters)

    def point(self) -> Array:
        """The point values, shape (P,) in the order of `parameter_names`."""
        values = [getattr(self, parameter.name) for parameter in BASE_PARAMETERS]
        for setting in self.effects:
            values += setting.values.values()
        return np.array(values, dtype=np.float64)

    def complete(self, points: Array, names: tuple[str, ...]) -> Array:
        """Fill points (L, len(names)) over some parameters up to all of them, within physical ranges; shape (L, P)."""
        full = np.tile(self.point(), (points.shape[0], 1))
        order = self.parameter_names
        full[:, [order.index(name) for name in names]] = points
        bounds = self.parameters.values()
        return np.clip(full, [p.low for p in bounds], [p.high for p in bounds])

    def with_point(self, values: Mapping[str, float]) -> Model:
        """The same model with other point values for the named parameters; raises ValueError for unknown names."""
        point = dict(zip(self.parameter_names, self.point(), strict=True))
        for name, value in values.items():
            if name not in point:
                raise ValueError(f"{name!r} is no parameter of this model; it has {', '.join(point)}")
            point[name] = float(value)
        effects = tuple(
            EffectSetting(s.name, {key: point[f"{s.name}.{key}"] for key in s.values}) for s in self.effects
        )
        base = {parameter.name: point[parameter.name] for parameter in BASE_PARAMETERS}
        return replace(self, effects=effects, **base)


def coefficient_tables(
    model: Model, theta: Array, step_s: float, dtype: type = np.float64
) -> tuple[Base, Coefficients]:
    """Work out what the compiled step needs, for L parameter points.

    `theta` (L, P) in the order of `model.parameter_names`. Gives Base and Effects of arrays (L,); None if absent.
    """

    def table(values: Array) -> NDArray[np.floating]:
        return np.ascontiguousarray(values, dtype=dtype)

    radius, axial, x_icr = theta[:, 0], theta[:, 1], theta[:, 2]
    base = Base(table(0.5 * radius), table(0.5 * radius / axial), table(x_icr))
    tables: dict[str, tuple[NDArray[np.floating], ...] | None] = dict.fromkeys(MOTION_EFFECTS)
    terms: dict[bool, list[TermCoefficients]] = {True: [], False: []}
    column = len(BASE_PARAMETERS)
    for setting in model.effects:
        width = len(setting.effect.parameters)
        values = theta[:, column : column + width]
        column += width
        columns = tuple(map(table, setting.effect.coefficients(values, theta[:, :3], step_s)))
        if setting.name in TERMS:
            terms[TERMS[setting.name].target == COMMAND].append(table_entry(setting.name, columns))
        elif setting.effect.moves:
            tables[setting.name] = columns
    return base, Effects(**tables, command_terms=tuple(terms[True]) or None, body_terms=tuple(terms[False]) or None)
