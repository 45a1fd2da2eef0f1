"""Model f_theta of the robot, one definition of the physics for control, inference, gap and replay.

Here is the model file: TOML in, TOML out; every error is one line that names file, field and remedy.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from disco_hw.errors import InputError
from disco_hw.files import MODEL_TOML, describe, read_toml
from disco_hw.model.model import Belief, EffectSetting, Gaussian, Mixture, Model, Uniform

__all__ = ["Belief", "EffectSetting", "Gaussian", "Mixture", "Model", "Uniform", "load_model", "save_model"]

# Of the file; a later one that cannot be read as this gets a new number.
FORMAT = 1
Vector = list[float]
Matrix = list[list[float]]


class _BaseSection(msgspec.Struct, forbid_unknown_fields=True):
    wheel_radius_m: float
    axial_distance_m: float
    x_icr_m: float = 0.0


class _GaussianSection(msgspec.Struct, forbid_unknown_fields=True, tag="gaussian", tag_field="kind"):
    names: list[str]
    mean: Vector
    covariance: Matrix


class _MixtureSection(msgspec.Struct, forbid_unknown_fields=True, tag="mixture", tag_field="kind"):
    names: list[str]
    weights: Vector
    means: Matrix
    covariances: list[Matrix]


class _UniformSection(msgspec.Struct, forbid_unknown_fields=True, tag="uniform", tag_field="kind"):
    names: list[str]
    low: Vector
    high: Vector


_BeliefSection = _GaussianSection | _MixtureSection | _UniformSection


class _File(msgspec.Struct, forbid_unknown_fields=True):
    format: Literal[1]
    base: _BaseSection
    name: Annotated[str, Meta(min_length=1, max_length=64)] = "robot"
    missing_effects: list[str] = []
    effects: list[dict[str, Any]] = []
    belief: _BeliefSection | None = None


def load_model(path: Path | str) -> Model:
    """Read and validate a model file; raises InputError with one line naming file, field and remedy."""
    path = Path(path)
    raw = read_toml(path, MODEL_TOML)
    try:
        content = msgspec.convert(raw, _File)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {describe(error, _File, 'docs/control.md')}") from None
    try:
        return _model(content)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None


def _model(content: _File) -> Model:
    base = content.base
    for field in base.__struct_fields__:
        if not math.isfinite(getattr(base, field)):
            raise ValueError(f"base.{field}: not a finite number; write a finite value")
    effects = tuple(_effect(index, entry) for index, entry in enumerate(content.effects))
    return Model(
        wheel_radius_m=base.wheel_radius_m,
        axial_distance_m=base.axial_distance_m,
        x_icr_m=base.x_icr_m,
        effects=effects,
        belief=_belief(content.belief),
        name=content.name,
        missing_effects=tuple(content.missing_effects),
    )


def _effect(index: int, entry: dict[str, Any]) -> EffectSetting:
    values = dict(entry)
    name = values.pop("name", None)
    if not isinstance(name, str):
        raise ValueError(f"effects[{index}].name: missing; write the name of an effect")
    for key, value in values.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < math.inf:
            raise ValueError(f"effects[{index}] {name}.{key}: not a finite number; write a finite value")
    return EffectSetting(name, values)


def _belief(section: _BeliefSection | None) -> Belief | None:
    if section is None:
        return None
    names = tuple(section.names)
    try:
        match section:
            case _GaussianSection(mean=mean, covariance=covariance):
                return Gaussian(names, _array(mean, "mean"), _array(covariance, "covariance"))
            case _MixtureSection(weights=weights, means=means, covariances=covariances):
                if not len(weights) == len(means) == len(covariances):
                    raise ValueError("weights, means and covariances differ in number")
                components = tuple(
                    Gaussian(names, _array(mean, "means"), _array(covariance, "covariances"))
                    for mean, covariance in zip(means, covariances, strict=True)
                )
                return Mixture(_array(weights, "weights"), components)
            case _UniformSection(low=low, high=high):
                return Uniform(names, _array(low, "low"), _array(high, "high"))
    except ValueError as error:
        raise ValueError(f"belief: {error}; correct it or write the model again with `disco-hw infer`") from None


def _array(values: Vector | Matrix, what: str) -> np.ndarray:
    try:
        return np.array(values, dtype=np.float64)
    except ValueError:
        raise ValueError(f"{what} has rows of different lengths") from None


def save_model(model: Model, path: Path | str) -> None:
    """Write a model file that `load_model` reads back to the same numbers, bit for bit.

    Raises OSError; a file that was there is then as it was.
    """
    text, given = model_text(model).encode(), Path(path)
    if given.exists() and not given.is_file():
        # A pipe or a terminal; nothing can take its place.
        given.write_bytes(text)
        return
    target = given.resolve()
    new = target.with_name(f".{target.name}.new")
    try:
        with new.open("wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        new.replace(target)
    except OSError:
        new.unlink(missing_ok=True)
        raise


def model_text(model: Model) -> str:
    """Return the model as TOML text."""
    lines = [
        f"format = {FORMAT}",
        f"name = {msgspec.json.encode(model.name).decode()}",
        *([f"missing_effects = {list(model.missing_effects)!r}"] if model.missing_effects else []),
        "",
        "[base]",
        f"wheel_radius_m = {model.wheel_radius_m!r}",
        f"axial_distance_m = {model.axial_distance_m!r}",
        f"x_icr_m = {model.x_icr_m!r}",
    ]
    for setting in model.effects:
        lines += ["", "[[effects]]", f'name = "{setting.name}"']
        lines += [f"{key} = {value!r}" for key, value in setting.values.items()]
    belief = model.belief
    if belief is not None:
        lines += ["", "[belief]"]
        names = f"names = {msgspec.json.encode(list(belief.names)).decode()}"
        match belief:
            case Gaussian():
                lines += ['kind = "gaussian"', names, *_vector("mean", belief.means)]
                lines += _matrix("covariance", belief.covariances)
            case Mixture():
                lines += ['kind = "mixture"', names, *_vector("weights", belief.weights)]
                lines += _matrix("means", np.stack([component.means for component in belief.components]))
                lines += ["covariances = ["]
                for component in belief.components:
                    lines += ["    ["] + [f"        {row.tolist()!r}," for row in component.covariances] + ["    ],"]
                lines += ["]"]
            case Uniform():
                lines += ['kind = "uniform"', names, *_vector("low", belief.low), *_vector("high", belief.high)]
    return "\n".join(lines) + "\n"


def _vector(key: str, values: np.ndarray) -> list[str]:
    return [f"{key} = {values.tolist()!r}"]


def _matrix(key: str, values: np.ndarray) -> list[str]:
    return [f"{key} = [", *(f"    {row.tolist()!r}," for row in values), "]"]
