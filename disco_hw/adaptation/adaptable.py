"""Which models can be adapted, and a model with another belief over its geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from disco_hw.adaptation.coordinates import NAMES
from disco_hw.adaptation.guard import Geometry
from disco_hw.config import Prior
from disco_hw.effects.effect import Channel
from disco_hw.errors import InputError
from disco_hw.log.records import BeliefChange
from disco_hw.model import Gaussian, Model
from disco_hw.model.parameter import BASE_PARAMETERS

Array = NDArray[np.float64]


def check_adaptable(model: Model, uncertainty: str) -> None:
    """Raise InputError for a model or a planner that cannot be adapted, with what to do."""
    if uncertainty == "point":
        raise InputError('--adapt: control.uncertainty = "point" plans without a belief; write "ut" or "mc"')
    if model.belief is None or not set(NAMES) <= set(model.belief.names):
        raise InputError(
            "--adapt: the model has no belief over wheel radius, axial distance and x_icr; "
            "write one with `disco-hw infer`"
        )
    others = [s.name for s in model.effects if s.effect.channel is not Channel.COMMAND_TO_WHEEL]
    if others:
        raise InputError(
            f"--adapt: the model has the effect {others[0]}, which adaptation would take for a change of the geometry; "
            "run without --adapt"
        )


def believed_geometry(model: Model) -> Geometry:
    """Moments of the model's belief over the geometry; it must have one."""
    assert model.belief is not None
    order = [model.belief.names.index(name) for name in NAMES]
    return Geometry(model.belief.mean()[order], model.belief.covariance()[np.ix_(order, order)])


def possible_range(prior: Prior) -> tuple[Array, Array]:
    """Lowest and highest geometry (3,) that is physically possible and within the prior of robot.toml."""
    physical = {parameter.name: parameter for parameter in BASE_PARAMETERS}
    ranges = [(physical[name], getattr(prior, name)) for name in NAMES]
    low = np.array([max(parameter.low, given[0]) for parameter, given in ranges])
    high = np.array([min(parameter.high, given[1]) for parameter, given in ranges])
    return low, high


def with_geometry(model: Model, geometry: Geometry) -> Model:
    """The model with this belief over its geometry, independent of what else it believes."""
    belief = model.belief
    assert belief is not None
    order = [belief.names.index(name) for name in NAMES]
    mean, covariance = belief.mean().copy(), belief.covariance().copy()
    covariance[order, :] = 0.0
    covariance[:, order] = 0.0
    mean[order] = geometry.mean
    covariance[np.ix_(order, order)] = geometry.covariance
    return replace(model, belief=Gaussian(belief.names, mean, covariance))


def geometry_of(change: BeliefChange) -> Geometry | None:
    """The geometry of a recorded change, None for the model file's."""
    if change.source == "model":
        return None
    return Geometry(np.array(change.mean), np.array(change.covariance).reshape(3, 3))
