"""The parameter points that every command sequence is rolled out under, and their weights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from disco_hw.control.sigma_points import sigma_points
from disco_hw.model import Belief, Mixture, Model
from disco_hw.model.parameter import BASE_PARAMETERS, X_ICR
from disco_hw.model.terms import effect_of

Array = NDArray[np.float64]
DOMINANT_WEIGHT = 0.9


def moving_names(belief: Belief) -> tuple[str, ...]:
    """Those parameters of a belief that change motion, x_icr last.

    Then the sigma points along the last column of the square root differ from the mean in x_icr alone, and the rollout
    of the three is shared.
    """
    base = {parameter.name for parameter in BASE_PARAMETERS}
    moving = [name for name in belief.names if name in base or effect_of(name.split(".")[0]).moves]
    return tuple(sorted(moving, key=lambda name: name == X_ICR.name))


def moments(belief: Belief) -> tuple[Array, Array]:
    """Mean and covariance for the unscented transform, over `moving_names`.

    A mixture gives its dominant component above a weight of 0.9 (paper, section IV-C), else its overall moments.
    """
    mean, covariance = belief.mean(), belief.covariance()
    if isinstance(belief, Mixture):
        weight, component = belief.dominant()
        if weight >= DOMINANT_WEIGHT:
            mean, covariance = component.means, component.covariances
    kept = [belief.names.index(name) for name in moving_names(belief)]
    return mean[kept], covariance[np.ix_(kept, kept)]


def point_estimate(model: Model) -> tuple[Array, Array]:
    """The model's point values as the only point: (1, P), weight (1,)."""
    return model.point()[None], np.ones(1)


def unscented_points(model: Model, alpha: float) -> tuple[Array, Array]:
    """Sigma points over all parameters of the model, (L, P), within their physical ranges; weights (L,), sum one."""
    belief = model.belief
    if belief is None or not moving_names(belief):
        return point_estimate(model)
    sigma = sigma_points(*moments(belief), alpha)
    return model.complete(sigma.points, moving_names(belief)), sigma.mean_weights


def drawn_points(model: Model, count: int, seed: int, step: int) -> Array:
    """Draws of the belief over all parameters of the model, (count, P), within their physical ranges.

    A pure function of seed and step number. The command delay keeps its mean: it shifts whole rows of commands.
    """
    belief = model.belief
    if belief is None:
        return np.tile(model.point(), (count, 1))
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, step]))
    draws = belief.draw(count, rng)
    if "command_delay.delay_s" in belief.names:
        column = belief.names.index("command_delay.delay_s")
        draws[:, column] = belief.mean()[column]
    return model.complete(draws, belief.names)


def mean_point(model: Model) -> Array:
    """The mean of the belief over all parameters of the model, (1, P), within their physical ranges."""
    if model.belief is None:
        return model.point()[None]
    return model.complete(model.belief.mean()[None], model.belief.names)


def twins(model: Model, points: Array) -> NDArray[np.int64]:
    """For points (L, P), those that differ from one in x_icr alone: (L, 2), -1 for none, -2 for being such a twin.

    Only pairs of twins count, as the unscented transform makes them.
    """
    found = np.full((len(points), 2), -1)
    others = np.delete(points, model.parameter_names.index(X_ICR.name), axis=1)
    for i, row in enumerate(others):
        alike = [j for j in range(i + 1, len(points)) if found[j, 0] == -1 and np.array_equal(others[j], row)]
        if found[i, 0] == -1 and len(alike) >= 2:
            found[i] = alike[:2]
            found[alike[:2]] = -2
    return found
