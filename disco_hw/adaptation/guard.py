"""The geometry that adaptation estimates: which adaptation runs, and the checks before an estimate is put in force."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from disco_hw.config import Control, PoseInput, Prior
from disco_hw.effects import Channel
from disco_hw.errors import InputError
from disco_hw.log.records import BeliefChange
from disco_hw.model import Gaussian, Model
from disco_hw.model.model import BASE_PARAMETERS

Array = NDArray[np.float64]


NAMES = ("x_icr_m", "wheel_radius_m", "axial_distance_m")
"""Order of the geometry in arrays and in records."""
REQUESTED_BY_FILE = "control.adaptation"

LARGEST_DRIFT_M_S = 0.2
"""Chosen: on a slope that carries a robot faster its tyres hardly hold it."""

_LEAST_VARIANCE, _LARGEST_VARIANCE, _LEAST_EIGENVALUE = 1e-14, 1e4, 1e-9
"""Variances in m^2, and the smallest eigenvalue of a correlation matrix, that a float64 filter can still hold."""


@dataclass(frozen=True, eq=False, slots=True)
class Geometry:
    """A Gaussian over the geometry in the order of `NAMES`: `mean` (3,), `covariance` (3, 3).

    `drift_m_s`: how fast the ground carries the moving robot along x and y of the world, as on a slope.
    `lateral_lag_s`: how long the body's sideways speed lags behind its turning.
    """

    mean: Array
    covariance: Array
    drift_m_s: tuple[float, float] = (0.0, 0.0)
    lateral_lag_s: float = 0.0

    @property
    def std(self) -> Array:
        """Standard deviations (3,) of the geometry, in the order of `NAMES`."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def geometry_fault(geometry: Geometry, low: Array, high: Array) -> str:
    """Say why a geometry must not be driven by, in one sentence; empty if nothing speaks against it.

    `low` and `high` (3,) bound the mean: the prior of robot.toml.
    """
    mean, covariance = geometry.mean, geometry.covariance
    drift_m_s = math.hypot(*geometry.drift_m_s)
    if not all(np.isfinite(part).all() for part in (mean, covariance, drift_m_s, geometry.lateral_lag_s)):
        return "the estimate is not finite"
    if drift_m_s > LARGEST_DRIFT_M_S:
        return f"the ground would carry the robot by {drift_m_s:.2f} m/s, more than {LARGEST_DRIFT_M_S:g}"
    variances = np.diag(covariance)
    if not ((variances > _LEAST_VARIANCE) & (variances < _LARGEST_VARIANCE)).all():
        return "the estimate has no covariance"
    deviations = np.sqrt(variances)
    if np.linalg.eigvalsh(covariance / np.outer(deviations, deviations))[0] < _LEAST_EIGENVALUE:
        return "the estimate has no covariance"
    outside = (mean < low) | (mean > high)
    if outside.any():
        worst = int(np.argmax(outside))
        return f"{NAMES[worst]} {mean[worst]:.4g} is outside [{low[worst]:g}, {high[worst]:g}]"
    return ""


def check_adaptable(model: Model, uncertainty: str, requested_by: str = "--adapt") -> None:
    """Raise InputError for a model or a planner that cannot be adapted, with what to do.

    `requested_by`: the option or field that asked for adaptation.
    """
    if uncertainty == "point":
        raise InputError(f'{requested_by}: control.uncertainty = "point" plans without a belief; write "ut" or "mc"')
    if model.belief is None or not set(NAMES) <= set(model.belief.names):
        raise InputError(
            f"{requested_by}: the model has no belief over wheel radius, axial distance and x_icr; "
            "write one with `disco-hw infer`"
        )
    # Encoders that miscount are among them. No model corrects poses: effects of their sensor are counted nowhere else.
    others = [s.name for s in model.effects if s.effect.channel is Channel.WHEEL_TO_BODY]
    if others:
        raise InputError(
            f"{requested_by}: the model has the effect {others[0]}, which adaptation would mistake for a change of "
            f"the geometry; leave {requested_by} out"
        )


@dataclass(frozen=True, slots=True)
class AdaptationChoice:
    """Choice of the adaptation that runs, "off" or "fast", with the reason."""

    kind: Literal["off", "fast"]
    why: str

    @property
    def report(self) -> str:
        """Return what runs and why, for the operator."""
        what = "estimated while driving" if self.kind == "fast" else "not estimated"
        return f"the geometry is {what}: {self.why}"


def choose_adaptation(control: Control, pose: PoseInput, model: Model) -> AdaptationChoice:
    """Return the adaptation for `control.adaptation`; "auto" is the filter where the model allows it.

    Raises InputError for one that is asked for and that the model does not allow.
    """
    requested = control.adaptation
    why, to_remove = f'{REQUESTED_BY_FILE} = "{requested}"', ""
    if pose.rate_hz is not None:
        to_remove += "; remove pose.rate_hz, which decides nothing any more and will be refused later"
    if control.disturbance:
        to_remove += "; remove control.disturbance, which does nothing any more and will be refused later"
    if requested == "off":
        return AdaptationChoice("off", why + to_remove)
    if requested == "audited":
        why += '; write "fast": its second estimator was no better and is gone'
    try:
        check_adaptable(model, control.uncertainty, REQUESTED_BY_FILE)
    except InputError as error:
        if requested != "auto":
            raise
        return AdaptationChoice("off", str(error) + to_remove)
    return AdaptationChoice("fast", why + to_remove)


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
    """Return the model with this belief over its geometry, independent of what else it believes."""
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
    """Return the geometry of a recorded change, None for the model file's."""
    if change.source == "model":
        return None
    drift_m_s = change.drift_x_m_s, change.drift_y_m_s
    return Geometry(np.array(change.mean), np.array(change.covariance).reshape(3, 3), drift_m_s, change.lateral_lag_s)
