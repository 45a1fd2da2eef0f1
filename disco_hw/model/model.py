"""Robot model of base parameters, the effects it has, and the belief over all of them.

A belief is a joint Gaussian, a mixture of them, or a uniform box.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from disco_hw import config
from disco_hw.effects import Effect, Parameter
from disco_hw.effects.registry import MOTION_EFFECTS, REGISTRY
from disco_hw.files import nearest
from disco_hw.model.added_terms import table_entry
from disco_hw.model.coefficients import Base, Coefficients, Effects, TermCoefficients
from disco_hw.model.terms import COMMAND, REACH, TERMS, effect_of

Array = NDArray[np.float64]


def _checked_covariance(covariance: Array, size: int, what: str) -> Array:
    """Return a read-only copy; raises ValueError unless it is finite, symmetric and positive definite."""
    matrix = np.array(covariance, dtype=np.float64)
    if matrix.shape != (size, size):
        raise ValueError(f"{what} has shape {matrix.shape}, not ({size}, {size})")
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{what} holds a value that is not finite")
    scale = np.sqrt(np.abs(np.diag(matrix)))
    if np.any(np.abs(matrix - matrix.T) > 1e-9 * np.outer(scale, scale) + 1e-300):
        raise ValueError(f"{what} is not symmetric")
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        raise ValueError(f"{what} is not positive definite") from None
    # Numbers that were rounded on their way are symmetric to the last bit from here on, as the estimator wants them.
    matrix = 0.5 * (matrix + matrix.T)
    matrix.setflags(write=False)
    return matrix


def _checked_vector(vector: Array, size: int, what: str) -> Array:
    values = np.array(vector, dtype=np.float64)
    if values.shape != (size,):
        raise ValueError(f"{what} has {values.size} entries, not {size}")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{what} holds a value that is not finite")
    values.setflags(write=False)
    return values


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Joint Gaussian belief: one vector of means (P,) and one covariance matrix (P, P).

    Raises ValueError for wrong shapes, non-finite values or a wrong covariance.
    """

    names: tuple[str, ...]
    means: Array
    covariances: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "means", _checked_vector(self.means, len(self.names), "mean"))
        object.__setattr__(self, "covariances", _checked_covariance(self.covariances, len(self.names), "covariance"))

    def mean(self) -> Array:
        """Mean vector, shape (P,)."""
        return self.means

    def covariance(self) -> Array:
        """Covariance matrix, shape (P, P)."""
        return self.covariances

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        factor = np.linalg.cholesky(self.covariances)
        return np.asarray(self.means + rng.standard_normal((count, len(self.names))) @ factor.T)


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of joint Gaussians over the same names; `weights` (C,) are positive and are normalised here.

    Raises ValueError for components that disagree or weights that are none.
    """

    weights: Array
    components: tuple[Gaussian, ...]

    def __post_init__(self) -> None:
        if not self.components:
            raise ValueError("a mixture needs at least one component")
        weights = _checked_vector(self.weights, len(self.components), "weights")
        if np.any(weights <= 0.0):
            raise ValueError("weights must all be positive")
        if any(component.names != self.components[0].names for component in self.components):
            raise ValueError("the components name different parameters")
        normalised = weights / weights.sum()
        normalised.setflags(write=False)
        object.__setattr__(self, "weights", normalised)

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of all arrays."""
        return self.components[0].names

    def mean(self) -> Array:
        """Mean of the mixture, shape (P,)."""
        return np.asarray(sum(w * c.means for w, c in zip(self.weights, self.components, strict=True)))

    def covariance(self) -> Array:
        """Covariance of the mixture (within plus between components), shape (P, P)."""
        mean = self.mean()
        total = np.zeros((mean.size, mean.size))
        for weight, component in zip(self.weights, self.components, strict=True):
            offset = component.means - mean
            total += weight * (component.covariances + np.outer(offset, offset))
        return total

    def dominant(self) -> tuple[float, Gaussian]:
        """Weight and component of the largest weight."""
        index = int(np.argmax(self.weights))
        return float(self.weights[index]), self.components[index]

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        which = rng.choice(len(self.components), size=count, p=self.weights)
        draws = np.empty((count, len(self.names)))
        for index, component in enumerate(self.components):
            chosen = which == index
            draws[chosen] = component.draw(int(chosen.sum()), rng)
        return draws


@dataclass(frozen=True, eq=False)
class Uniform:
    """Independent uniform ranges, as a prior; raises ValueError unless low < high, all finite."""

    names: tuple[str, ...]
    low: Array
    high: Array

    def __post_init__(self) -> None:
        low = _checked_vector(self.low, len(self.names), "low")
        high = _checked_vector(self.high, len(self.names), "high")
        if np.any(low >= high):
            raise ValueError("low must be below high in every entry")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def mean(self) -> Array:
        """Mean vector, shape (P,)."""
        return np.asarray(0.5 * (self.low + self.high))

    def covariance(self) -> Array:
        """Diagonal covariance, shape (P, P)."""
        return np.diag((self.high - self.low) ** 2 / 12.0)

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Independent draws, shape (count, P)."""
        return np.asarray(rng.uniform(self.low, self.high, (count, len(self.names))))


Belief = Gaussian | Mixture | Uniform
"""A joint distribution over the parameters `names`, in the order of all arrays; P is their number."""

WHEEL_RADIUS = Parameter("wheel_radius_m", "m", 0.005, 2.0, 0.06, neutral=0.06)
AXIAL_DISTANCE = Parameter("axial_distance_m", "m", 0.02, 5.0, 0.4, neutral=0.4)
X_ICR = Parameter("x_icr_m", "m", -2.0, 2.0, 0.0)

BASE_PARAMETERS = (WHEEL_RADIUS, AXIAL_DISTANCE, X_ICR)


@dataclass(frozen=True)
class EffectSetting:
    """An effect of a model with its parameter values; `reach` is optional for terms given by a formula.

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
        values = {REACH.name: REACH.neutral, **self.values} if self.name in TERMS else self.values
        for given in values:
            if given not in expected:
                raise ValueError(f"{self.name}.{given}: no such parameter; {self.name} has {', '.join(expected)}")
        for parameter in self.effect.parameters:
            if parameter.name not in values:
                raise ValueError(f"{self.name}.{parameter.name}: missing; add its value in {parameter.unit}")
            _check_range(f"{self.name}.{parameter.name}", parameter, values[parameter.name])
        ordered = {name: float(values[name]) for name in expected}
        object.__setattr__(self, "values", MappingProxyType(ordered))

    @property
    def effect(self) -> Effect:
        """Effect that the setting names."""
        return effect_of(self.name)


def _check_range(name: str, parameter: Parameter, value: float) -> None:
    if not parameter.low <= value <= parameter.high:
        raise ValueError(
            f"{name}: {value} is outside [{parameter.low}, {parameter.high}] {parameter.unit}; write a value inside it"
        )


def within_ranges(covariance: Array, parameters: Sequence[Parameter]) -> Array:
    """Narrow a covariance (P, P) so that no standard deviation exceeds its parameter's range; correlations stay."""
    std = np.sqrt(np.diag(covariance))
    widths = np.array([parameter.high - parameter.low for parameter in parameters])
    # A hair less than the range, which rounding must not exceed.
    factor = np.minimum(1.0, (1.0 - 1e-9) * widths / std)
    return np.asarray(covariance * np.outer(factor, factor))


@dataclass(frozen=True)
class Model:
    """The transition function's parameters and what is believed of them.

    `base` and `effects` hold the point values; `belief` is a joint distribution over any of `parameter_names`, and
    parameters it does not name are known exactly. `missing_effects` names effects of the robot that the model is known
    to lack, so that its parameters may have absorbed them. Raises ValueError for repeated effects, values outside their
    physical range, a belief over parameters that the model does not have, with a mean outside their range or wider than
    it, or a missing effect that is unknown or there.
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
                raise ValueError(f"missing_effects: {effect!r} is also listed in effects; remove it from one of them")
        if self.belief is not None:
            for believed in self.belief.names:
                if believed not in self.parameter_names:
                    raise ValueError(
                        f"belief over {believed!r}, which this model does not have; "
                        f"it has {', '.join(self.parameter_names)}"
                    )
                if self.belief.names.count(believed) > 1:
                    raise ValueError(f"belief names {believed!r} twice; keep one")
            variances = np.diag(self.belief.covariance()).tolist()
            for believed, mean, variance in zip(self.belief.names, self.belief.mean().tolist(), variances, strict=True):
                parameter = self.parameters[believed]
                _check_range(f"belief: mean of {believed}", parameter, mean)
                std, width, unit = math.sqrt(variance), parameter.high - parameter.low, parameter.unit
                if not std <= width:
                    raise ValueError(
                        f"belief: standard deviation of {believed} is {std:.3g} {unit}, wider than its whole range of "
                        f"{width:.4g} {unit}; write the model again with `disco-hw infer`"
                    )

    @classmethod
    def nominal(cls, robot: config.Robot, prior: config.Prior | None = None) -> Model:
        """Return the geometry of robot.toml without effects; with a prior, that uniform prior is the belief."""
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
        """Dict from full names to parameters: base ones first, then `effect.parameter`."""
        found = {parameter.name: parameter for parameter in BASE_PARAMETERS}
        for setting in self.effects:
            found |= {f"{setting.name}.{parameter.name}": parameter for parameter in setting.effect.parameters}
        return found

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Full names of all parameters, in the order of every parameter vector."""
        return tuple(self.parameters)

    def point(self) -> Array:
        """Return the point values, shape (P,) in the order of `parameter_names`."""
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
        """Return the model with other point values for the named parameters; raise ValueError for unknown names."""
        point = dict(zip(self.parameter_names, self.point(), strict=True))
        for name, value in values.items():
            if name not in point:
                raise ValueError(f"{name!r} is not a parameter of this model; it has {', '.join(point)}")
            point[name] = float(value)
        effects = tuple(
            EffectSetting(s.name, {key: point[f"{s.name}.{key}"] for key in s.values}) for s in self.effects
        )
        base = {parameter.name: point[parameter.name] for parameter in BASE_PARAMETERS}
        return replace(self, effects=effects, **base)


def coefficient_tables(
    model: Model, theta: Array, step_s: float, dtype: type = np.float64
) -> tuple[Base, Coefficients]:
    """Return Base and Effects, with arrays (L,), for the compiled step at L parameter points.

    `theta` (L, P) in the order of `model.parameter_names`. What is absent is None.
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
